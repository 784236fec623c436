"""The base class of the API's pydantic models."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True, extra="forbid")
