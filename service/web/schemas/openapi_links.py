"""OpenAPI links: from an operation that returns an id to the operations that take it.

An operation that takes the id of a job or a scene must be added to `_JOB` or `_SCENE` by hand.
"""

from __future__ import annotations

from typing import Any

_JOB = ("get_job", "cancel_job", "job_events", "job_photo", "job_trace", "job_render", "export_pose", "share_job")
_SCENE = (
    *("get_scene", "scene_thumbnail", "scene_splats", "render_scene", "load_scene", "unload_scene", "delete_scene"),
    *("get_registration", "register_scene", "undo_registration", "get_coverage", "measure_coverage"),
    "cancel_coverage",
    *("list_anchors", "put_anchor", "delete_anchor"),
)

# (operation, status) -> parameter, where the response has it, the operations that take it.
_LINKS = {
    ("localize_photo", "200"): ("job_id", "$response.body#/id", _JOB),
    ("localize_photo", "202"): ("job_id", "$response.body#/id", _JOB),
    ("list_jobs", "200"): ("job_id", "$response.body#/jobs/0/id", _JOB),
    ("upload_scene", "201"): ("scene_id", "$response.body#/id", _SCENE),
    ("list_scenes", "200"): ("scene_id", "$response.body#/scenes/0/id", _SCENE),
    ("list_keys", "200"): ("name", "$response.body#/keys/0/name", ("remove_key",)),
    ("list_lenses", "200"): ("lens_id", "$response.body#/lenses/0/id", ("delete_lens",)),
}


def add_links(schema: dict[str, Any]) -> None:
    """Add the links to an OpenAPI document."""
    # Generators of clients and of tests (schemathesis) follow them.
    for operations in schema["paths"].values():
        for operation in operations.values():
            for status, response in operation["responses"].items():
                found = _LINKS.get((operation["operationId"], status))
                if found:
                    name, place, targets = found
                    response["links"] = {t: {"operationId": t, "parameters": {name: place}} for t in targets}
