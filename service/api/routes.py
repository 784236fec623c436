"""The routes: thin. Each takes validated values, asks the job service or the scenes, and returns a model.

    POST   /localize                              202 + Location (200 with `Prefer: wait=N` when done in time)
    GET    /jobs                                  newest first
    GET    /jobs/{id}                             state, result or error
    DELETE /jobs/{id}                             cancel; takes effect between two records
    GET    /jobs/{id}/events                      server-sent events: `record`..., then `result` or `error`
    GET    /jobs/{id}/photo                       JPEG: upright, as decoded
    GET    /jobs/{id}/trace                       all records
    GET    /jobs/{id}/iterations/{k}/render.jpg   record k's pose (or `last`), photo's size
    GET    /scenes                                GET /scenes/{id}
    GET    /scenes/{id}/splats?max=N              binary, see `service/api/splats.py`
    GET    /capabilities /version /livez /readyz

An event `record` has the record's index as its id and a `Record` as its data; the final event has the id `end`
and a `JobOut` as its data: `result` if the job succeeded, `error` if it failed or was cancelled.
"""
