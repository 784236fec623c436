"""The hint of an error that has none of its own: what its field may have, with a right example; else what to do.

Examples are JSON that the API accepts in that field; `tests/test_errors.py` sends them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

EXAMPLES: Mapping[str, Any] = {
    "scene": "studio",
    "estimator": "view_index",
    "options": {"candidates": 3},
    "intrinsics": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
    "camera_id": "robot-7",
    "prior": {"position": [0, 0, 1.5], "quaternion_wxyz": [1, 0, 0, 0], "sigma_deg": 20, "sigma_units": 0.5},
    "up_in_camera": {"direction": [0, -1, 0], "sigma_deg": 1},
    "gps": {"latitude": 47.3769, "longitude": 8.5417, "sigma_m": 5},
    "heading": {"degrees": 120, "sigma_deg": 15},
    "accuracy": {"deg": 2, "share": 0.01},
    "truth": {"position": [0, 0, 1.5], "quaternion_wxyz": [1, 0, 0, 0]},
    "every": 3,
    "times_s": [0, 0.2, 0.4],
    "rig": {
        "cameras": [
            {
                "rig_from_camera": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
                "intrinsics": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
            }
            for x in (0, 0.1)
        ]
    },
    "seed": 7,
    "budget_s": 10,
    "deadline_s": 60,
    "keep_photo": True,
}
"""A right value of each field of a request to localize."""

_POSE = "world_from_camera or camera_from_world (4x4), or position with quaternion_wxyz; convention: opencv or opengl"
_ALLOWED: Mapping[str, str] = {
    "scene": "The id of a scene of GET /scenes, a list of ids, or auto.",
    "estimator": "A name of GET /capabilities.",
    "options": "A JSON object with options of the estimator, by their schema in GET /capabilities.",
    "intrinsics": "A JSON object: width, height, fx, fy, cx, cy in pixels; optionally model, distortion, "
    "trust (exact or approximate).",
    "camera_id": "1 to 64 letters, digits, spaces and any of . _ : @ -",
    "prior": f"A JSON object: {_POSE}; optionally sigma_deg with sigma_units, or covariance (6x6), or box (2x3).",
    "up_in_camera": "A JSON object: direction, three numbers in the camera's axes (OpenCV); optionally sigma_deg.",
    "gps": "exif, for the photo's own; or a JSON object: latitude, longitude and sigma_m; optionally height (metres "
    "above the ellipsoid) and height_sigma_m.",
    "heading": "A JSON object: degrees, clockwise from true north; optionally sigma_deg.",
    "accuracy": "A JSON object: deg, and at most one of units, metres (of a scene with a scale) and share.",
    "truth": f"A JSON object: {_POSE}.",
    "every": "A whole number from 1 on; for a sequence only.",
    "times_s": "A JSON list of seconds, ascending, one for each photo of a sequence.",
    "rig": "A JSON object: cameras, one for each photo in its order, each with rig_from_camera (4x4) and intrinsics; "
    "optionally convention (opencv or opengl) and metric.",
    "seed": "A whole number from 0 to 9223372036854775807.",
    "budget_s": "Seconds, greater than 0 and at most 3600.",
    "deadline_s": "Seconds, greater than 0 and at most 86400.",
    "keep_photo": "true or false.",
}
_ELSEWHERE: Mapping[str, str] = {
    "estimators": _ALLOWED["estimator"],
    "photo": "Send a JPEG, PNG, WebP or HEIC file, or a video: -F photo=@photo.jpg",
    "pose": f"A JSON object: {_POSE}. Example: {json.dumps(EXAMPLES['truth'])}",
    "format": "png, jpeg or depth.",
    "quality": "A whole number from 1 to 100.",
    "body": "Send a JSON object with the fields of the operation in /openapi.json.",
    "sensorReadings": 'Example: {"sensorReadings": {"cameraReadings": [{"imageBytes": "BASE64"}]}}',
    "cameraReadings": "imageBytes is a photo in base64; params has a COLMAP camera model, and needs size.",
}
_BY_CODE: Mapping[str, str] = {
    "backend_missing": "GET /capabilities lists what can run here.",
    "bad_request": "Send a complete HTTP request.",
    "bad_input": "Change the request; /docs describes it.",
    "content_too_large": "Send a smaller file, or ask the operator to raise SPLATFIX_MAX_UPLOAD_BYTES.",
    "corrupt_scene": "Copy or export the file again.",
    "deadline_exceeded": "Allow more time, or send it again when the queue is shorter.",
    "device_memory_full": "Send it again when fewer jobs run, or ask the operator to serve fewer scenes at once.",
    "estimator_fault": "Choose another estimator, and report this one.",
    "forbidden": "Use a key with a higher role: splatfix keys add NAME --role localize",
    "idempotency_conflict": "Use a new key for a new request.",
    "internal_error": "Report it with the request's id, which is in the header X-Request-ID.",
    "interrupted": "Send the request again.",
    "invalid_image": _ELSEWHERE["photo"],
    "invalid_request": "See the operation in /docs.",
    "job_not_found": "GET /jobs lists the jobs that are kept.",
    "job_not_ready": "Wait for the job: GET /jobs/ID/events, or send Prefer: wait=30.",
    "anchor_not_found": "GET /scenes/{id}/anchors lists them.",
    "key_not_found": "GET /keys lists them.",
    "lens_not_found": "GET /lenses lists yours.",
    "method_not_allowed": "The header Allow has the methods of this path.",
    "no_geo_anchor": "Add geo_anchor to the scene's scene.json, and localize again.",
    "no_keys": "Open the page without a token.",
    "no_pose": "See the job's reason: GET /jobs/ID.",
    "not_found": "/docs lists all paths.",
    "photo_gone": "Send keep_photo=true to keep it as long as the job.",
    "queue_full": "Try again later.",
    "rate_limited": "Send fewer requests; Retry-After has the seconds to wait.",
    "record_not_found": "GET /jobs/ID/trace has all records.",
    "request_timeout": "Send it again on a faster connection, or a smaller file.",
    "scene_exists": "Delete the scene first, or choose another name.",
    "scene_in_use": "Unload the scene, and wait for its jobs.",
    "scene_not_found": "GET /scenes lists the scenes.",
    "scene_not_ready": "Try again later.",
    "scene_too_large": "Raise SPLATFIX_SCENE_MEMORY_BYTES, or serve a smaller scene.",
    "scene_unloaded": "Load it: POST /scenes/ID/load.",
    "storage_failed": "Free space on the service's disk, and check that its data folder is writable.",
    "unauthorized": "Send a valid key: Authorization: Bearer KEY.",
    "unavailable": "Try again in a few seconds.",
    "unsupported_format": "Convert the scene to a format that GET /capabilities lists.",
    "unsupported_media_type": "With curl: -F photo=@photo.jpg",
}


def hint_for(code: str, where: str) -> str:
    """Return the hint of an error by its field, else by its code; never empty for the API's own codes."""
    field = where.partition(".")[0]
    # Of a scene that can't be read `where` is a file, as scene.ply, and no field.
    if code in ("corrupt_scene", "unsupported_format"):
        return _BY_CODE[code]
    if field in _ALLOWED and code != "scene_not_found":
        return f"{_ALLOWED[field]} Example: {field}={_written(EXAMPLES[field])}"
    return _ELSEWHERE.get(field) or _BY_CODE.get(code, "See /docs.")


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
