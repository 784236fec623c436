"""The array shapes and types of the annotations, checked while the tests run.

`install` puts an import hook before the others. It wraps each function and each dataclass of the named packages whose
annotations name a jaxtyping array: beartype compares arguments, result and fields with them, and a dimension's name
stands for one size within a call. Compiled kernels stay as they are, and so do processes that the tests start.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.machinery
import importlib.util
import inspect
import marshal
import os
import sys
import typing
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from beartype.door import is_bearable
from jaxtyping import AbstractArray, jaxtyped

_COMPILERS = ("service.jit", "numba", "llvmlite")
_WRITTEN_BY = Path(__file__).read_bytes()


class ShapeError(TypeError):
    """An array has not the shape or the type that an annotation gives it."""


def install(packages: Sequence[str]) -> None:
    """Check what is imported from now on out of these packages."""
    assert not [m for m in sys.modules if m.split(".")[0] in packages], "too late: something is imported already"
    sys.meta_path.insert(0, Finder(packages))


class Finder:
    def __init__(self, packages: Sequence[str]) -> None:
        self._packages = packages

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name.split(".")[0] not in self._packages:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname: str) -> Any:
        """Return the code with checks, kept in __pycache__ beside the code without them."""
        source = self.get_data(self.path)
        key = hashlib.sha256(b"\0".join((_WRITTEN_BY, self.path.encode(), source))).digest()
        kept = Path(importlib.util.cache_from_source(self.path, optimization="shapes"))
        with suppress(OSError):
            data = kept.read_bytes()
            if data.startswith(key):
                return marshal.loads(data[len(key) :])
        code = self.source_to_code(source, self.path)
        if not sys.dont_write_bytecode:
            with suppress(OSError):
                kept.parent.mkdir(exist_ok=True)
                written = kept.with_suffix(f".{os.getpid()}")
                written.write_bytes(key + marshal.dumps(code))
                written.replace(kept)  # whole or not at all: other workers write it, too
        return code

    def source_to_code(self, data: Any, path: Any, *, _optimize: int = -1) -> Any:
        tree = ast.parse(data)
        if b"jaxtyping" not in data:
            return compile(tree, path, "exec", dont_inherit=True, optimize=_optimize)
        arrays, compilers = _imported(tree, ("jaxtyping",)), _imported(tree, _COMPILERS)
        for node in ast.walk(tree) if arrays else ():
            names = {n.id for d in getattr(node, "decorator_list", ()) for n in ast.walk(d) if isinstance(n, ast.Name)}
            if isinstance(node, ast.FunctionDef) and not names & compilers and _mentions(node, arrays):
                node.decorator_list.append(_decorator("checked_calls", node))
            elif isinstance(node, ast.ClassDef) and "dataclass" in names and _mentions(node, arrays):
                node.decorator_list.insert(0, _decorator("checked_fields", node))
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True, optimize=_optimize)


def _imported(tree: ast.Module, modules: Sequence[str]) -> set[str]:
    """Return the names that come from these modules or from below them."""
    return {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(tuple(modules))
        for alias in node.names
    }


def _mentions(node: ast.FunctionDef | ast.ClassDef, names: set[str]) -> bool:
    """Whether an annotation of the signature, or of the class's fields, has one of the names."""
    if isinstance(node, ast.ClassDef):
        annotations = [a.annotation for a in node.body if isinstance(a, ast.AnnAssign)]
    else:
        a = node.args
        arguments = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
        annotations = [node.returns, *(argument.annotation for argument in arguments if argument)]
    found = {n.id for hint in annotations if hint for n in ast.walk(hint) if isinstance(n, ast.Name)}
    return bool(found & names)


def _decorator(name: str, node: ast.AST) -> ast.expr:
    call = ast.parse(f"__import__({__name__!r}).{name}", mode="eval").body
    return typing.cast(ast.expr, ast.copy_location(call, node))


def checked_calls(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its arguments and its result checked."""
    names = list(inspect.signature(function).parameters)
    check = _Check(function)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        hints = check.hints
        given = [(name, value) for name, value in zip(names, args, strict=False) if name in hints]
        if kwargs:
            given += [(name, value) for name, value in kwargs.items() if name in hints]
        check(given)
        result = function(*args, **kwargs)
        if "return" in hints:
            check([*given, ("return", result)])
        return result

    return checked


def checked_fields(cls: type) -> type:
    """Return the dataclass with its fields checked once they are set."""
    set_fields = cls.__init__
    check = _Check(cls)

    @functools.wraps(set_fields)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        set_fields(self, *args, **kwargs)
        check([(name, getattr(self, name)) for name in check.hints])

    cls.__init__ = checked  # type: ignore[method-assign]
    return cls


class _Check:
    """Compares values with the annotations of a function or a class."""

    def __init__(self, owner: Any) -> None:
        self._owner = owner
        self._passed: set[tuple[Any, ...]] = set()

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Not before the first call: an annotation may name a class from further down."""
        return {n: hint for n, hint in typing.get_type_hints(self._owner).items() if _has_array(hint)}

    def __call__(self, values: Sequence[tuple[str, Any]]) -> None:
        """Raise ShapeError unless all fit; what has the types and shapes of earlier ones fits, too."""
        outline = tuple([(n, v.dtype, v.shape) if type(v) is np.ndarray else (n, type(v)) for n, v in values])
        if outline in self._passed:
            return
        with jaxtyped("context"):
            for name, value in values:
                if not _fits(value, self.hints[name]):
                    where = f"{self._owner.__module__}.{self._owner.__qualname__}"
                    raise ShapeError(f"{where}: {name} is {_told(value)}, and not {self.hints[name]}")
        if all(isinstance(value, np.ndarray | float | int | None) for _, value in values):
            self._passed.add(outline)


def _told(value: Any) -> str:
    return f"{getattr(value, 'dtype', type(value))} {getattr(value, 'shape', '')}"


def _has_array(hint: Any) -> bool:
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_has_array, typing.get_args(hint)))


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type, and every item of a list or a tuple: beartype looks at a random one."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (list, tuple, Sequence) and isinstance(value, origin):
        items = parts if origin is tuple and parts[-1] is not ... else parts[:1] * len(value)
        return len(items) == len(value) and all(map(_fits, value, items))
    return is_bearable(value, hint)
