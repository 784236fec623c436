"""Stored values as JSON text: dataclasses of `results`, `types` and `model`, with their arrays, to text and back.

`{"version": 1, "value": ...}`: a dataclass is an object of its fields, an array nested lists, an enumeration its value,
a tuple a list. What to read is given by the type hints, so nothing in the text chooses a class. A field with a default
may be missing, and one that is not known, of a later release beside which this one runs, is left out. So fields may be
added; one that a program of the release before must not leave out, a new value of an enumeration, and any other change
need a migration of the store, which that program can't read.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from enum import Enum
from functools import cache
from typing import Any, TypeVar

import numpy as np
from jaxtyping import AbstractArray

VERSION = 1

_T = TypeVar("_T")


def encode(value: Any) -> str:
    """Return a dataclass as JSON text; floats survive exactly, NaN and infinities as JavaScript spells them."""
    return json.dumps({"version": VERSION, "value": _plain(value)}, separators=(",", ":"))


def decode(kind: type[_T], text: str) -> _T:
    """Read a `kind` that `encode` wrote.

    Raises ValueError for another version, TypeError for a missing field.
    """
    envelope = json.loads(text)
    if envelope["version"] != VERSION:
        raise ValueError(f"stored by another program: version {envelope['version']}")
    return _typed(kind, envelope["value"])


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _plain(getattr(value, name)) for name in _field_names(type(value))}
    # `tolist` gives Python's numbers, whose text is exact.
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _typed(kind: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return _typed(_member(arguments, value), value)
    if dataclasses.is_dataclass(kind):
        hints = _hints(kind)  # type: ignore[arg-type]
        known = {name: _typed(hints[name], item) for name, item in value.items() if name in hints}
        return kind(**known)  # type: ignore[operator]
    # The annotation has dtype and fixed dimensions, so they need not be stored.
    if isinstance(kind, type) and issubclass(kind, AbstractArray):
        return np.array(value, np.dtype(kind.dtypes[0])).reshape(_shape(kind, value))
    if origin is tuple:
        if arguments[1:] == (...,):
            return tuple(_typed(arguments[0], item) for item in value)
        return tuple(_typed(part, item) for part, item in zip(arguments, value, strict=True))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(value)
    return value


def _shape(kind: Any, value: Any) -> tuple[int, ...]:
    """Return an array's shape; an empty list has lost all but its first dimension: the fixed ones are in the hint."""
    if len(value):
        return np.shape(value)
    return (0, *(getattr(dim, "size", 0) for dim in kind.dims[1:]))


def _member(members: tuple[Any, ...], value: Any) -> Any:
    """Return the member of a union that fits a JSON value by its type and, of an object, its fields."""
    if value is None:
        return type(None)
    if isinstance(value, dict):
        fitting = [member for member in members if dataclasses.is_dataclass(member) and _has_fields(member, value)]
    else:
        # Unions of the stored classes differ in their fields or in the JSON type.
        plain = [member for member in members if not dataclasses.is_dataclass(member) and member is not type(None)]
        fitting = [member for member in plain if _fits(member, value)]
    if not fitting:
        raise ValueError(f"no member of {members} fits {type(value).__name__}")
    return fitting[0]


def _has_fields(kind: Any, value: dict[str, Any]) -> bool:
    """Whether an object may be of this dataclass: has its fields but those with a default."""
    missing = (dataclasses.MISSING, dataclasses.MISSING)
    return {
        field.name for field in dataclasses.fields(kind) if (field.default, field.default_factory) == missing
    } <= value.keys()


def _fits(member: Any, value: Any) -> bool:
    if isinstance(value, list):
        return typing.get_origin(member) is tuple or (isinstance(member, type) and issubclass(member, AbstractArray))
    return typing.get_origin(member) is not tuple


@cache
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)
