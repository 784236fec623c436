"""The registrations in force of the scenes of a process, read again when their files change."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from service.errors import SplatfixError
from service.registration.registration import Registration
from service.registration.registration_file import RegistrationFile
from service.scene_formats.remote_scene import RemoteScene
from service.types import SceneInfo

_log = logging.getLogger(__name__)
_Stamp = tuple[Path, int, int]


class SceneRegistrations:
    """Safe to use from several threads."""

    def __init__(self, data_folder: Path | None) -> None:
        """`data_folder` is where registrations are that can't be beside their scenes."""
        self._data_folder = data_folder
        self._read: dict[Path, tuple[_Stamp, Registration | None]] = {}

    def of(self, scene: Path | None, info: SceneInfo, remote: RemoteScene | None = None) -> Registration | None:
        """Return the registration in force, None if there is none, or only one of another version of the scene."""
        found = self._current(scene, remote) if scene is not None else None
        if found is not None and found.scene_sha256 != info.sha256:
            return None
        return found

    def _current(self, scene: Path, remote: RemoteScene | None) -> Registration | None:
        file = RegistrationFile(scene, self._data_folder, remote)
        try:
            path = file.path
            facts = path.stat()
        except OSError:
            return None
        stamp = path, facts.st_mtime_ns, facts.st_ino
        known = self._read.get(scene)
        if known is None or known[0] != stamp:
            try:
                known = stamp, file.current()
            except SplatfixError as error:  # photos can be localized without
                _log.error("the scene at %s is taken as not registered: %s", scene, error)
                known = stamp, None
            self._read[scene] = known
        return known[1]


def registered_info(info: SceneInfo, registration: Registration | None) -> SceneInfo:
    """Return what is known of a scene, with what its registration determines in place of the manifest's."""
    if registration is None:
        return info
    up = registration.up_in_world
    return replace(
        info,
        geo_anchor=registration.geo_anchor or info.geo_anchor,
        metres_per_unit=registration.metres_per_unit or info.metres_per_unit,
        up_in_world=info.up_in_world if up is None else tuple(up.tolist()),
    )
