"""The OpenAPI description of the API, for /openapi.json and openapi.yaml."""

from __future__ import annotations

from typing import Any

import yaml
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from service.web.problems import Problem
from service.web.schemas.error_examples import example_components
from service.web.schemas.job_results import Record
from service.web.schemas.jobs import Restarted
from service.web.schemas.openapi_links import add_links
from service.web.schemas.requests import LocalizeIn

_KEYS = "An API key, or a token from `/tokens`; not needed if the service has no keys."
_SUMMARY = "Estimate where a photo was taken inside a 3D Gaussian Splatting scene."
_DESCRIPTION = """
Post a photo to `/localize`, wait for the job, read the pose. Poses are in the scene's own frame and units, with the
camera axes of OpenCV (+x right, +y down, +z forward) unless a field says otherwise; quaternions are wxyz.
A photo that can't be localized is a result (`not_localized`, with a reason), not an error.
Every error is a problem document (RFC 9457) with a stable `code`; each operation lists its codes, each with an
example. Unknown paths get `not_found`, other methods `method_not_allowed`.
A job that ended without a result has a problem document as its `error`.
"""


def description(app: FastAPI) -> dict[str, Any]:
    """Return the description, with the models that no route declares."""
    # Cached in the app: describing every model takes a while.
    if not app.openapi_schema:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            summary=_SUMMARY,
            description=_DESCRIPTION,
            routes=app.routes,
        )
        _, extra = models_json_schema(
            [(LocalizeIn, "validation"), *((model, "serialization") for model in (Problem, Record, Restarted))],
            ref_template="#/components/schemas/{model}",
        )
        models = schema.setdefault("components", {}).setdefault("schemas", {})
        models |= {name: model for name, model in extra["$defs"].items() if name not in models}
        schema["components"]["examples"] = example_components()
        schema["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer", "description": _KEYS}}
        schema["security"] = [{"key": []}, {}]  # {}: none, for a service without keys
        _drop_default_validation(schema)
        add_links(schema)
        app.openapi_schema = schema
    return app.openapi_schema


def _drop_default_validation(schema: dict[str, Any]) -> None:
    """Remove FastAPI's own 422 responses: a failed validation is answered with a problem document and 400."""
    for operations in schema["paths"].values():
        for operation in operations.values():
            # Ours is a problem document, of another media type: a 422 of that kind stays.
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]
    for name in ("HTTPValidationError", "ValidationError"):
        schema["components"]["schemas"].pop(name, None)


def description_as_yaml(app: FastAPI) -> str:
    """Return the description as YAML, the text of openapi.yaml."""
    return yaml.safe_dump(description(app), sort_keys=False, width=100, allow_unicode=True)
