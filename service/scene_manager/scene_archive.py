"""Take a scene's files out of a ZIP of a scene folder, or of a trainer's output folder.

Only files that a scene is read from are taken, under their own names; what the archive says of paths, links and sizes
is not trusted. What operating systems add (`__MACOSX/`, `._*`, `.DS_Store`) is no content, and backslashes, which some
Windows programs write, are separators.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from service.errors import CorruptScene, UnsupportedFormat
from service.pose.training_photos.digest_file import DIGEST_FILE
from service.scene_formats.formats import is_scene_file
from service.scene_formats.inria import ARGUMENTS, CAMERAS
from service.scene_formats.layouts import COLMAP_FOLDER, STEPS
from service.scene_formats.manifest import MANIFEST
from service.scene_formats.multiset import POSES
from service.scene_formats.nerfstudio import DATAPARSER
from service.scene_formats.training_files import CAMERA_FRAME

_MAX_MEMBERS = 20_000
_MAX_PHOTOS = 5_000
"""Training photos that are stored: readers take sizes from them that a camera file lacks."""
_MAX_PHOTO_BYTES = 64 * 1024**2
_MAX_NAME_BYTES = 255
"""On all usual file systems."""
_MAX_DEPTH = 4
_COPY_BYTES = 1 << 20
_OWN_NAMES = {MANIFEST, ARGUMENTS, CAMERAS, DATAPARSER, DIGEST_FILE, CAMERA_FRAME, POSES}
_PHOTOS = (".jpg", ".jpeg", ".png", ".webp")
_SYSTEM_FOLDER = "__MACOSX"


def unpack(archive: Path, folder: Path, max_bytes: int) -> None:
    """Write the files of a scene into the folder. Raises CorruptScene, UnsupportedFormat, OSError."""
    left, photos = max_bytes, 0
    with _reading():
        opened = zipfile.ZipFile(archive)
    with opened:
        members = {m: path for m in opened.infolist() if (path := _content(m)) is not None}
        if len(members) > _MAX_MEMBERS:
            raise CorruptScene(f"the archive holds more than {_MAX_MEMBERS} files.", where="archive")
        relative = {m: path for m, path in members.items() if not path.is_absolute() and path.parts}
        # Absolute names are taken from their root where there are no others, which they could collide with.
        members = relative or {m: path.relative_to("/") for m, path in members.items() if path.is_absolute()}
        top = _common_top(list(members.values()))
        for member, path in members.items():
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                # LZMA takes as much memory as the archive says, up to 4 GB.
                raise UnsupportedFormat("only stored and deflated files are read.", where="archive")
            wanted = path.relative_to(top)
            is_photo = _is_photo(wanted)
            photos += is_photo
            if (is_photo and photos <= _MAX_PHOTOS and member.file_size <= _MAX_PHOTO_BYTES) or _is_scenes(wanted):
                with _reading():
                    source = opened.open(member)
                with source:
                    left = _copied(source, folder / wanted, left)


def _content(member: zipfile.ZipInfo) -> PurePosixPath | None:
    """Return a member's path; None of a folder and of what an operating system added."""
    # zipfile replaces os.sep only, which is "/" here.
    path = PurePosixPath(member.filename.replace("\\", "/"))
    added = path.parts[:1] == (_SYSTEM_FOLDER,) or path.name.startswith("._") or path.name == ".DS_Store"
    return None if added or member.filename.endswith(("/", "\\")) else path


def _common_top(paths: list[PurePosixPath]) -> PurePosixPath:
    """Return the folder that all files are in, if there is one: many pack the folder, others what is in it."""
    tops = {path.parts[:1] for path in paths}
    nested = all(len(path.parts) > 1 for path in paths)
    inner = {(PurePosixPath(pattern).parts[0],) for pattern in (COLMAP_FOLDER.as_posix(), *STEPS)}
    if len(tops) == 1 and nested and not tops & inner:
        return PurePosixPath(*tops.pop())
    return PurePosixPath()


def _is_scenes(path: PurePosixPath) -> bool:
    """Whether a scene may be read from a member of this name."""
    if not _is_safe(path):
        return False
    if path.parts == (path.name,):
        camera_file = re.fullmatch(r"transforms\w*\.json", path.name) is not None
        return is_scene_file(Path(path)) or path.name in _OWN_NAMES or camera_file or path.suffix.lower() == ".webp"
    if path.parent in (PurePosixPath(COLMAP_FOLDER), PurePosixPath("sparse")):
        return re.fullmatch(r"[a-zA-Z0-9]{1,40}\.(bin|txt)", path.name) is not None
    return any(path.match(pattern) and len(path.parts) == pattern.count("/") + 1 for pattern in STEPS)


def _is_photo(path: PurePosixPath) -> bool:
    return 1 < len(path.parts) <= _MAX_DEPTH and path.suffix.lower() in _PHOTOS and _is_safe(path)


def _is_safe(path: PurePosixPath) -> bool:
    """Whether each part may be the name of a file here: no `..`, nothing hidden, no signs that a system forbids."""
    return all(re.fullmatch(r"[\w-][\w. -]*", part) and len(part.encode()) <= _MAX_NAME_BYTES for part in path.parts)


@contextmanager
def _reading() -> Iterator[None]:
    """Blame the archive, not our disk. Raises CorruptScene."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError, ValueError, OSError) as error:
        raise CorruptScene(f"the archive can't be read: {str(error)[:200]}.", where="archive") from error


def _copied(source: IO[bytes], path: Path, left: int) -> int:
    """Copy at most `left` bytes into a new file; return how many more there may be. Raises CorruptScene, OSError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Two members may have one name, and on some file systems names differ in case only.
        target = path.open("xb")
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise CorruptScene("two files of the archive have the same name.", where="archive") from error
    with target:
        while True:
            with _reading():
                chunk = source.read(_COPY_BYTES)
            if not chunk:
                return left
            # The size in the archive is not trusted: small files can unpack to any size.
            left -= len(chunk)
            if left < 0:
                raise CorruptScene("the unpacked archive is too large.", where="archive")
            target.write(chunk)
