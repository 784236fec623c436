"""Registries of the exchangeable parts: estimators, matchers, renderers, scene formats.

A plug-in is a module with the functions that its registry requires. It comes from one of three places:

    built-in          a file in the registry's package, e.g. service/matchers/NAME.py
    plug-in folder    $SPLATFIX_PLUGINS_DIR/matchers/NAME.py; it is imported as service.matchers.NAME
    package           an installed distribution with the entry point NAME = "its.module" in splatfix.matchers

Only names found there are ever imported, so a name from an HTTP request can import nothing else. A module is
imported on first use: heavy libraries stay unloaded until something needs them.
"""

from __future__ import annotations

import os
import pkgutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType

from service.errors import BackendMissing, InvalidRequest, UnknownName

PLUGINS_DIR = "SPLATFIX_PLUGINS_DIR"
BUILT_IN, FOLDER = "built-in", "plug-in folder"


@dataclass(frozen=True, slots=True)
class _Plugin:
    entry: metadata.EntryPoint
    source: str
    """`built-in`, `plug-in folder`, or the distribution with its version."""


class PluginRegistry:
    """The plug-ins of one kind, e.g. `PluginRegistry("service.matchers", "splatfix.matchers", ("create",))`.

    `package` is the package of the built-in ones, `group` the entry points', `required` what a plug-in has to
    define. A file of the package or of the plug-in folder that doesn't define the first of them is a part of
    others; the source is searched for it, since an import may be slow. A plug-in may define
    `missing() -> str | None`: why it can't run on this machine.
    """

    def __init__(self, package: str, group: str, required: tuple[str, ...]) -> None:
        self.package, self._group, self._required = package, group, required
        self._kind = package.rsplit(".", 1)[-1]
        # Behind the package's own folder in its search path: `import package.name` finds the built-in one first.
        if os.environ.get(PLUGINS_DIR):
            sys.modules[package].__path__.append(str(Path(os.environ[PLUGINS_DIR], self._kind)))

    def names(self) -> tuple[str, ...]:
        """Return all names, the built-in ones first. Raises InvalidRequest if two plug-ins share one."""
        return tuple(self._found())

    def source(self, name: str) -> str:
        """Return where the plug-in comes from: `built-in`, `plug-in folder`, or the distribution with its version."""
        return self._plugin(name).source

    def missing(self, name: str) -> str | None:
        """Return why the plug-in can't run on this machine, or None if it can. Raises UnknownName."""
        try:
            self._import(name)
        except BackendMissing as error:
            return error.message
        return None

    def load(self, name: str) -> ModuleType:
        """Return the plug-in's module. Raises UnknownName, or BackendMissing with the reason."""
        try:
            return self._import(name)
        except BackendMissing as error:
            raise BackendMissing(f"'{name}' can't run here: {error.message}", where=self._kind) from error

    def available(self) -> Iterator[ModuleType]:
        """Yield the modules of all plug-ins that can run here."""
        for name in self.names():
            if self.missing(name) is None:
                yield self._import(name)

    def _import(self, name: str) -> ModuleType:
        """Import a plug-in and call its `missing`. Raises UnknownName, BackendMissing."""
        plugin = self._plugin(name)
        try:
            module = plugin.entry.load()
            absent = [function for function in self._required if not hasattr(module, function)]
            reason = f"it doesn't define {', '.join(absent)}." if absent else getattr(module, "missing", lambda: None)()
        except (Exception, SystemExit) as error:  # one broken plug-in must not take the others with it
            raise BackendMissing(f"{type(error).__name__}: {error}") from error
        if reason:
            raise BackendMissing(reason)
        return module

    def _plugin(self, name: str) -> _Plugin:
        found = self._found()
        if name not in found:
            raise UnknownName(f"unknown value '{name}'; known: {', '.join(found)}.", where=self._kind)
        return found[name]

    def _found(self) -> dict[str, _Plugin]:
        folders = tuple(sys.modules[self.package].__path__)
        return _discovered(self.package, folders, self._group, self._required[0], tuple(sys.path))


@cache
def _discovered(
    package: str, folders: tuple[str, ...], group: str, function: str, search_path: tuple[str, ...]
) -> dict[str, _Plugin]:
    """Find the plug-ins without importing any. Raises InvalidRequest if one takes a name that is in use.

    Cached, since it is needed for every request; `search_path` is sys.path, where distributions are looked for.
    """
    own = {info.name for info in pkgutil.iter_modules(folders[:1])}
    found: dict[str, _Plugin] = {}
    # The first folder is the package's own; others were appended.
    for folder in folders:
        source = BUILT_IN if folder == folders[0] else FOLDER
        for info in pkgutil.iter_modules([folder]):
            file = Path(folder, f"{info.name}.py")
            if not info.ispkg and f"\ndef {function}(" in file.read_text("utf-8", "replace"):
                if source != BUILT_IN:
                    _require_free(info.name, str(file), own, found)
                entry = metadata.EntryPoint(info.name, f"{package}.{info.name}", group)
                found[info.name] = _Plugin(entry, source)
    for entry in metadata.entry_points(group=group):
        source = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        _require_free(entry.name, f"the package {source}", own, found)
        found[entry.name] = _Plugin(entry, source)
    return found


def _require_free(name: str, place: str, own: set[str], found: dict[str, _Plugin]) -> None:
    # A part's name, too: `import package.name` would give the part instead of the plug-in.
    taken_by = found[name].source if name in found else BUILT_IN if name in own else None
    if taken_by:
        raise InvalidRequest(
            f"the plug-in '{name}' from {place} has a name that is taken ({taken_by}).",
            where=PLUGINS_DIR,
            hint="Rename it.",
        )
