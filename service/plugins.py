"""A folder of modules is a registry: a file in it is the registration.

Only names of files that are there are accepted, so a name from an HTTP request can never import anything
else. A module is imported on first use, so heavy libraries stay unloaded until someone asks for them.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path
from types import ModuleType

from service.errors import BackendMissing, UnknownName


class PluginFolder:
    """The plug-ins of one package, e.g. `PluginFolder("service.matchers", "create")`.

    A plug-in is a module that defines `marker` (modules without it are parts, not plug-ins; telling costs
    no import: the source is searched). A plug-in may define `missing() -> str | None`: why it can't run here.
    """

    def __init__(self, package: str, marker: str) -> None:
        self.package = package
        self._marker = f"\ndef {marker}("

    def names(self) -> tuple[str, ...]:
        return _modules_with(self._marker, tuple(importlib.import_module(self.package).__path__))

    def missing(self, name: str) -> str | None:
        """Return why the plug-in can't run on this machine, or None if it can."""
        reason = getattr(self._module(name), "missing", None)
        return reason() if reason else None

    def load(self, name: str) -> ModuleType:
        """Return the plug-in's module. Raises UnknownName, or BackendMissing with the reason."""
        module = self._module(name)
        reason = self.missing(name)
        if reason:
            raise BackendMissing(f"'{name}' can't run here: {reason}", where=self.package.rsplit(".", 1)[-1])
        return module

    def _module(self, name: str) -> ModuleType:
        if name not in self.names():
            kind = self.package.rsplit(".", 1)[-1]
            raise UnknownName(f"there is no '{name}'; known: {', '.join(self.names())}.", where=kind)
        return importlib.import_module(f"{self.package}.{name}")


@cache
def _modules_with(marker: str, folders: tuple[str, ...]) -> tuple[str, ...]:
    """Return the modules whose source has the marker; read once, since every request asks."""
    found = (info for info in pkgutil.iter_modules(folders) if not info.ispkg)
    sources = {i.name: Path(i.module_finder.path, f"{i.name}.py") for i in found}  # type: ignore[union-attr]
    return tuple(sorted(name for name, source in sources.items() if marker in source.read_text("utf-8")))
