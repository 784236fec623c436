"""The routes. Each takes validated values, calls the jobs or the scenes, and returns a model.

POST   /localize                              202 + Location (200 with `Prefer: wait=N` when done in time)
POST   /geopose                               the same for GeoPoseProtocol clients: on Earth, in one request
GET    /jobs                                  newest first, filtered, in pages
GET    /jobs/{id}                             state, result or error
DELETE /jobs/{id}                             cancel; takes effect between two records
GET    /jobs/{id}/events                      server-sent events: `record`..., then `result` or `error`
GET    /jobs/{id}/photo                       JPEG, upright
GET    /jobs/{id}/trace                       all records
GET    /jobs/{id}/iterations/{k}/render.jpg   record k's pose (or `last`), photo's size
GET    /jobs/{id}/export/{format}             the pose for COLMAP, nerfstudio, TUM tools or GeoPose
POST   /jobs/{id}/share                       a link for who has no key; GET /shared/{token}...
GET    /scenes                                GET /scenes/{id}
PUT    /scenes/{id}                           upload; POST .../load, .../unload; DELETE
GET    /scenes/{id}/thumbnail.jpg             small JPEG
GET    /scenes/{id}/splats?max=N              binary, see `service/scene_manager/splat_sample.py`
POST   /scenes/{id}/render                    colour or depth from any pose
GET    /scenes/{id}/coverage                  where a photo would be found; POST measures it
GET    /scenes/{id}/anchors                   named points; PUT, DELETE .../anchors/{name}
POST   /scenes/{id}/registration              where the scene is; GET, DELETE (undo)
WS     /scenes/{id}/live                      a moving camera's frames to poses, see docs/live.md
GET    /lenses                                DELETE /lenses, /lenses/{id}
GET    /keys                                  PUT, DELETE /keys/{name}; GET /key: the caller's own
POST   /tokens                                short-lived, for pages
GET    /capabilities, /version, /livez, /readyz, /metrics
"""

from __future__ import annotations

from fastapi import APIRouter, Depends

from service.web.routes import (
    anchors,
    coverage,
    geopose,
    jobs,
    keys,
    lenses,
    live,
    localize,
    registrations,
    scenes,
    shared,
    system,
)
from service.web.routes.dependencies import see_other_fronts_scenes

router = APIRouter()
for part in (localize, geopose, jobs, shared, lenses, keys, system):
    router.include_router(part.router)
for part in (scenes, anchors, coverage, registrations, live):
    router.include_router(part.router, dependencies=[Depends(see_other_fronts_scenes)])
