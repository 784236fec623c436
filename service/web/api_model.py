"""The base class of the API's pydantic models."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A model of the API: docstrings of its fields are their descriptions, and unknown fields are refused."""

    model_config = ConfigDict(use_attribute_docstrings=True, extra="forbid")
