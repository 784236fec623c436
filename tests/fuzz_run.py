"""The fuzz run: hostile bytes for every reader of files from outside, guided by coverage (atheris, libFuzzer).

    python tests/fuzz_run.py [--runs 200000] [--jobs 1] [TARGET...]

Needs `pip install splatfix[hostile]`. A target is one reader. A run fails if anything but the reader's own error comes
out, if it takes more than 1 s of CPU, or if memory grows beyond the target's limit. Prints the runs, the longest and
the largest one of each target as JSON; exits with 1 if a target failed (the input is then in the folder that is named).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import BinaryIO, NoReturn

HERE = Path(__file__).parent
MAX_S = 1.0
MB = 1_000_000
_HANG_S = 20
"""Wall time after which libFuzzer itself ends a run."""


@dataclass(frozen=True)
class Target:
    """What is fed, from where it starts, and what it may take."""

    run: Callable[[bytes], object]
    """Swallows the errors that are allowed, raises the others."""
    seeds: Mapping[str, bytes]
    max_bytes: int
    max_memory: int
    words: tuple[str, ...] = ()
    """For libFuzzer's dictionary."""


# ------------------------------------------------------------------ scenes


def scene_target(
    name: str,
    seeds: Mapping[str, bytes],
    words: tuple[str, ...] = (),
    *,
    beside: Mapping[str, bytes] | None = None,
    read: Callable[[Path], object] | None = None,
) -> Target:
    """Read a folder in which one file is hostile; those `beside` it are not. `read`: not the whole scene."""
    from service.errors import SceneError
    from service.scene_formats import load_scene

    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    for other, data in (beside or {}).items():
        (folder / other).write_bytes(data)

    def run(data: bytes) -> None:
        file.write_bytes(data)
        with suppress(SceneError):
            if read:
                read(folder)
                return
            scene = load_scene(folder)
            arrays = scene.means, scene.quats, scene.scales, scene.opacities, scene.sh
            assert len({len(array) for array in arrays}) == 1

    # A scene is held several times while it is activated, in float64 for a moment.
    return Target(run, seeds, 8192, 64 * MB, words)


def ply(count: int = 2, degree: int = 1, kind: str = "float", order: str = "little") -> bytes:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    head = f"ply\nformat binary_{order}_endian 1.0\ncomment antialiased 0\nelement vertex {count}\n"
    head += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    code = {"float": "f", "double": "d"}[kind]
    row = struct.pack(f"{'<' if order == 'little' else '>'}{len(names)}{code}", *(0.5 for _ in names))
    return head.encode() + count * row


def compressed_ply(count: int = 3, colours: bool = True, rest: int = 9) -> bytes:
    bounds = [f"{end}_{p}{axis}" for p in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    bounds += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colours else []
    head = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n"
    head += "".join(f"property float {name}\n" for name in bounds)
    head += f"element vertex {count}\n"
    head += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    head += f"element sh {count}\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(rest)) if rest else ""
    data = struct.pack(f"<{len(bounds)}f", *(0.0 if "min" in name else 1.0 for name in bounds))
    data += count * struct.pack("<4I", 0x12345678, 0x87654321, 0x0F0F0F0F, 0xFFEEDDCC)
    return head.encode() + b"end_header\n" + data + count * rest * b"\x80"


_PLY_WORDS = (
    *("ply\\x0a", "format binary_little_endian 1.0\\x0a", "binary_big_endian", "ascii", "element vertex ", "comment "),
    *("element chunk ", "element sh ", "property float ", "property double ", "property uchar ", "property list "),
    *("end_header\\x0a", "f_rest_", "scale_2", "rot_3", "SplatRenderMode: mip", "antialiased 1", "999999999999"),
)
_FRAME = {"file_path": "./a", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
_JSON_WORDS = ("[", "]", "{", "}", "null", "true", "1e999", "-1", "NaN", "Infinity", "1e308", "\\\\ud800", "9" * 30)


def ply_target() -> Target:
    seeds = {"float": ply(), "double": ply(1, 0, "double"), "big": ply(1, 0, "float", "big"), "three": ply(1, 3)}
    return scene_target("scene.ply", seeds, _PLY_WORDS)


def compressed_ply_target() -> Target:
    seeds = {"plain": compressed_ply(), "old": compressed_ply(colours=False), "flat": compressed_ply(rest=0)}
    return scene_target("scene.ply", seeds, _PLY_WORDS)


def splat_target() -> Target:
    row = struct.pack("<6f8B", 0, 0, 0, 1, 1, 1, 255, 0, 0, 255, 255, 128, 128, 128)
    return scene_target("scene.splat", {"one": row, "three": 3 * row})


def written_target(*names: str) -> Target:
    """Files of other programs (tests/data/formats)."""
    files = [HERE / "data" / "formats" / name for name in names]
    words = ("meta.json", "codebook", "NGSP", "glTF", "JSON", "bufferView", "byteOffset", "VP8L", "count")
    target = scene_target(f"scene{files[0].suffix}", {f.name: f.read_bytes() for f in files}, words)
    return replace(target, max_bytes=65_536)


def checkpoint_target() -> Target:
    """The pickle in a checkpoint's ZIP, whose checksums are made anew: nothing would come through otherwise."""
    import torch

    from service.errors import SceneError
    from service.scene_formats import checkpoint
    from service.scene_formats.checkpoint_process import extracted
    from service.scene_formats.gaussians import MAX_GAUSSIANS, checked

    # In this process: one of its own, as the service starts, takes seconds.
    read = lambda path, folder: extracted(path, folder, MAX_GAUSSIANS)  # noqa: E731
    checkpoint._extracted = lambda path, folder: checkpoint.checked_answer(read(path, folder), path.name)
    shapes = {"means": (3, 3), "quats": (3, 4), "scales": (3, 3), "opacities": (3,), "sh0": (3, 1, 3)}
    whole = BytesIO()
    torch.save({"step": 1, "splats": {name: torch.ones(shape) for name, shape in shapes.items()}}, whole)
    with zipfile.ZipFile(whole) as opened:
        parts = {name: opened.read(name) for name in opened.namelist()}
    (pickled,) = [name for name in parts if name.endswith("/data.pkl")]
    file = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)) / "scene.pt"

    def run(data: bytes) -> None:
        with zipfile.ZipFile(file, "w") as packed:
            for name, part in parts.items():
                packed.writestr(name, data if name == pickled else part)
        with suppress(SceneError):
            checked(checkpoint.read(file), file.name)

    return Target(run, {"gsplat": parts[pickled]}, 8192, 64 * MB, ("splats", "means", "shN", "pipeline", "collections"))


def sog_meta_target() -> Target:
    with zipfile.ZipFile(HERE / "data" / "formats" / "v2.sog") as bundle:
        files = {name: bundle.read(name) for name in bundle.namelist()}
    words = (*_JSON_WORDS, "means", "quats", "codebook", "shN", "files", "mins", "version", "count")
    return scene_target("meta.json", {"v2": files.pop("meta.json")}, words, beside=files)


def inria_target() -> Target:
    from service.scene_formats.inria import read_cameras

    camera = {"img_name": "a", "width": 9, "height": 9, "fx": 9, "fy": 9, "position": [0, 0, 0]}
    seed = json.dumps([camera | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]).encode()
    read = lambda folder: read_cameras(folder / "cameras.json", lambda name: True)  # noqa: E731
    return scene_target("cameras.json", {"one": seed}, (*_JSON_WORDS, *camera), read=read)


def multiset_target() -> Target:
    from service.scene_formats.multiset import is_of_multiset, read_cameras

    pose = {"ts": "1.5", "T": [1, 2, 3], "R": [0, 0, 0, 1], "RGB": None}
    seed = json.dumps({"poses": [pose, pose]}).encode()

    def read(folder: Path) -> object:
        path = folder / "poses.json"
        return is_of_multiset(path) and read_cameras(path, lambda name: True)

    return scene_target("poses.json", {"two": seed}, (*_JSON_WORDS, "poses", *pose), read=read)


def manifest_target() -> Target:
    text = (HERE.parent / "service" / "scene_formats" / "manifest.py").read_text("utf-8")
    example = text[text.index("{") : text.index("Every key")].replace("scene.ply", "scene.ply")
    keys = re.findall(r'"(\w+)":', example)
    small = b'{"up": [0, 0, 1], "training_size": [64, 48]}'
    seeds = {"all": example.encode(), "small": small}
    return scene_target("scene.json", seeds, (*_JSON_WORDS, *keys), beside={"scene.ply": ply()})


def transforms_target() -> Target:
    camera = {"camera_model": "OPENCV", "fl_x": 80, "fl_y": 80, "cx": 48, "cy": 32, "w": 96, "h": 64}
    nerfstudio = {**camera, "frames": [_FRAME, {**_FRAME, "file_path": "b", "w": 9}], "train_filenames": ["a", "b"]}
    blender = {"camera_angle_x": 0.7, "background": [0, 0, 0], "w": 8, "h": 8, "frames": [_FRAME]}
    words = (*_JSON_WORDS, "camera_angle_x", "frames", "file_path", "transform_matrix", "test_filenames", "fl_x")
    sizeless = {"fl_x": 9, "frames": [_FRAME]}
    named = {"nerfstudio": nerfstudio, "blender": blender, "sizeless": sizeless}
    seeds = {name: json.dumps(value).encode() for name, value in named.items()}
    from service.scene_formats.folder import _training
    from service.scene_formats.manifest import Manifest

    return scene_target(
        "transforms.json", seeds, words, read=lambda folder: _training(folder, Manifest(), lambda name: True)
    )


_BIN_CAMERAS = struct.pack("<QiiQQ4d", 1, 1, 1, 96, 64, 80, 80, 48, 32)
_BIN_IMAGES = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.jpg\0" + struct.pack("<Qddq", 1, 1, 2, -1)
_TXT_CAMERAS = b"# cameras\n1 PINHOLE 96 64 80 80 48 32\n2 SIMPLE_RADIAL 96 64 80 48 32 0.1\n"
_TXT_IMAGES = b"# images\n1 1 0 0 0 0 0 0 1 a.jpg\n1.0 2.0 -1\n2 1 0 0 0 1 2 3 2 b c.jpg\n\n"


def colmap_target(fed: str, seed: bytes, beside: str, twin: bytes) -> Target:
    from service.scene_formats.colmap import read_cameras

    words = ("PINHOLE", "FULL_OPENCV", "nan", "1e400")
    return scene_target(
        f"sparse/0/{fed}",
        {"one": seed},
        words,
        beside={f"sparse/0/{beside}": twin},
        read=lambda folder: read_cameras(folder / "sparse" / "0", lambda name: True),
    )


# ------------------------------------------------------------------ archives and photos


def archive_target() -> Target:
    """A ZIP of a scene folder, as it is uploaded."""
    from service.errors import BadInput, SceneError, StorageFailed
    from service.scene_manager.scene_store import FolderSceneStore

    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    store = FolderSceneStore([], folder, 4 * MB)

    def run(data: bytes) -> None:
        try:
            with store.draft("room") as draft:
                draft.write(data)
                draft.commit("scene.ply")
            store.delete("room")
        except (SceneError, BadInput, StorageFailed):
            pass
        assert {path.name for path in folder.iterdir()} == {".incoming"}

    seeds = {}
    for name, kind in (("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED), ("lzma", zipfile.ZIP_LZMA)):
        buffer = BytesIO()
        with zipfile.ZipFile(buffer, "w", kind) as opened:
            opened.writestr("room/scene.ply", ply(1, 0))
            opened.writestr("room/transforms.json", json.dumps({"frames": []}))
        seeds[name] = buffer.getvalue()
    return Target(
        run, seeds, 8192, 128 * MB, ("../", "scene.ply", "sparse/0/cameras.bin", "scene.json", "PK\\x01\\x02")
    )


class HeicChild:
    """Does what heic_decoder_process.py does without starting Python each time. A crash in it is no finding."""

    def __init__(self) -> None:
        self._process: tuple[int, BinaryIO, BinaryIO] | None = None

    def run(self, *_: object, input: bytes, **__: object) -> SimpleNamespace:
        pid, asked, told = self._process = self._process or self._started()
        asked.write(struct.pack("<I", len(input)) + input)
        asked.flush()
        head = told.read(4)
        if len(head) < 4:
            _, status = os.waitpid(pid, 0)
            self._process = None
            raise subprocess.CalledProcessError(status, "heic_decoder_process")
        return SimpleNamespace(stdout=told.read(*struct.unpack("<I", head)))

    def _started(self) -> tuple[int, BinaryIO, BinaryIO]:
        (asked, ask), (told, tell) = os.pipe(), os.pipe()
        pid = os.fork()
        if not pid:
            os.close(ask), os.close(told)
            self._serve(os.fdopen(asked, "rb"), os.fdopen(tell, "wb"))
        os.close(asked), os.close(tell)
        return pid, os.fdopen(ask, "wb"), os.fdopen(told, "rb")

    def _serve(self, asked: BinaryIO, tell: BinaryIO) -> NoReturn:
        from service.photos import heic_decoder_process
        from service.photos.images import DEFAULTS

        for number in (signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        while head := asked.read(4):
            signal.alarm(_HANG_S)
            data = asked.read(*struct.unpack("<I", head))
            answer = b"".join(heic_decoder_process.decoded(data, DEFAULTS.max_pixels))
            tell.write(struct.pack("<I", len(answer)) + answer)
            tell.flush()
        os._exit(0)


def photo_target(kind: str) -> Target:
    import service.photos.heic
    from service.errors import InvalidImage
    from service.photos.images import read_query

    if kind == "heic":
        service.photos.heic.subprocess = SimpleNamespace(
            run=HeicChild().run,
            CalledProcessError=subprocess.CalledProcessError,
            TimeoutExpired=subprocess.TimeoutExpired,
        )

    def run(data: bytes) -> None:
        try:
            query = read_query(data)
        except InvalidImage:
            return
        height, width, channels = query.rgb.shape
        assert channels == 3
        assert (query.intrinsics.width, query.intrinsics.height) == (width, height)
        assert max(width, height) <= 1300

    words = ("Exif\\x00\\x00", "MM\\x00*", "II*\\x00", "IHDR", "IDAT", "eXIf", "iCCP", "acTL", "tRNS", "PLTE")
    # A WebP of `max_pixels_webp` takes 433 MB.
    return Target(run, photos(kind), 32_768, 500 * MB, words)


def photos(kind: str) -> dict[str, bytes]:
    import numpy as np
    from PIL import Image

    pixels = np.random.default_rng(1).integers(0, 256, (36, 48, 4), np.uint8)
    smooth = Image.fromarray(np.sort(pixels, 1))
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 28

    def saved(mode: str, **options) -> bytes:
        file = BytesIO()
        smooth.convert(mode).save(file, kind, **options)
        return file.getvalue()

    if kind == "jpeg":
        return {
            "exif": saved("RGB", exif=exif, quality=60),
            "progressive": saved("RGB", progressive=True, quality=60),
            "gray": saved("L", quality=40),
            "cmyk": saved("CMYK", quality=40),
        }
    if kind == "png":
        deep = BytesIO()
        Image.fromarray(np.sort(pixels, 1)[:, :, 0].astype(np.uint16) * 257).save(deep, "png")
        modes = {mode: saved(mode, exif=exif) for mode in ("RGB", "RGBA", "L", "LA", "P", "1")}
        return modes | {"deep": deep.getvalue(), "palette": saved("P", transparency=3)}
    if kind == "webp":
        frames = {"save_all": True, "append_images": [smooth.rotate(90)]}
        return {
            "lossy": saved("RGB", quality=40, exif=exif),
            "alpha": saved("RGBA", quality=40),
            "lossless": saved("RGB", lossless=True),
            "frames": saved("RGB", **frames),
        }
    return {"rotated": (HERE / "data" / "rotated.heic").read_bytes()}


TARGETS: dict[str, Callable[[], Target]] = {
    "ply": ply_target,
    "compressed_ply": compressed_ply_target,
    "splat": splat_target,
    "spz": lambda: written_target("v3.spz", "v4.spz"),
    "sog": lambda: written_target("v2.sog"),
    "sog_meta": sog_meta_target,
    "ksplat": lambda: written_target("level0.ksplat", "level1.ksplat", "level2.ksplat"),
    "gltf": lambda: written_target("plain.glb"),
    "checkpoint": checkpoint_target,
    "inria_cameras": inria_target,
    "multiset_poses": multiset_target,
    "manifest": manifest_target,
    "transforms": transforms_target,
    "colmap_cameras_bin": lambda: colmap_target("cameras.bin", _BIN_CAMERAS, "images.bin", _BIN_IMAGES),
    "colmap_images_bin": lambda: colmap_target("images.bin", _BIN_IMAGES, "cameras.bin", _BIN_CAMERAS),
    "colmap_cameras_txt": lambda: colmap_target("cameras.txt", _TXT_CAMERAS, "images.txt", _TXT_IMAGES),
    "colmap_images_txt": lambda: colmap_target("images.txt", _TXT_IMAGES, "cameras.txt", _TXT_CAMERAS),
    "archive": archive_target,
    "photo_jpeg": lambda: photo_target("jpeg"),
    "photo_png": lambda: photo_target("png"),
    "photo_webp": lambda: photo_target("webp"),
    "photo_heic": lambda: photo_target("heic"),
}


# ------------------------------------------------------------------ one target, in a process of its own


class Measured:
    """Times and weighs each run; keeps the greatest of both in a file, since libFuzzer ends the process itself."""

    def __init__(self, target: Target, report: Path) -> None:
        self._target, self._report = target, report
        self._before = _peak()
        self._longest_s = self._largest = 0.0

    def __call__(self, data: bytes) -> None:
        began = time.process_time()
        self._target.run(data)
        took_s, grown = time.process_time() - began, _peak() - self._before
        if took_s > self._longest_s or grown > self._largest:
            self._longest_s, self._largest = max(took_s, self._longest_s), max(grown, self._largest)
            self._report.write_text(json.dumps({"longest_s": self._longest_s, "largest_mb": self._largest / MB}))
        if took_s > MAX_S:
            raise AssertionError(f"took {took_s:.2f} s")
        if grown > self._target.max_memory:
            raise AssertionError(f"took {grown / MB:.0f} MB")


def _peak() -> int:
    """Return the most memory that the process ever had, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def child(name: str, folder: Path, runs: int, seed: int) -> None:
    import atheris

    with atheris.instrument_imports(
        include=["service.scene_formats", "service.photos.images", "service.scene_manager.scene_store", "PIL"]
    ):
        target = TARGETS[name]()
    corpus = folder / "corpus"
    corpus.mkdir()
    for key, data in target.seeds.items():
        (corpus / key).write_bytes(data)
        target.run(data)
    (folder / "words").write_text("".join(f'"{word}"\n' for word in target.words or ("\\x00",)))
    options = [
        *(f"-runs={runs}", f"-seed={seed}", f"-max_len={target.max_bytes}", f"-timeout={_HANG_S}"),
        *(f"-dict={folder / 'words'}", f"-artifact_prefix={folder}/", "-rss_limit_mb=4096", "-print_final_stats=1"),
        *("-verbosity=1", str(corpus)),
    ]
    atheris.Setup([sys.argv[0], *options], Measured(target, folder / "report.json"))
    atheris.Fuzz()


# ------------------------------------------------------------------ all of them


def fuzz(name: str, runs: int, seed: int) -> dict:
    folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-"))
    command = [sys.executable, __file__, "--child", name, "--folder", str(folder), "--runs", str(runs)]
    began = time.monotonic()
    environment = os.environ | {"PYTHONPATH": f"{HERE.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    with (folder / "log").open("w") as log:
        code = subprocess.call([*command, "--seed", str(seed)], stdout=log, stderr=log, env=environment)
    text = (folder / "log").read_text(errors="replace")
    done = re.search(r"number_of_executed_units:\s*(\d+)", text)
    report = folder / "report.json"
    figures = json.loads(report.read_text()) if report.exists() else {}
    covered = re.findall(r"cov: (\d+)", text)
    found = {
        "runs": int(done[1]) if done else 0,
        "seconds": round(time.monotonic() - began),
        "edges": int(covered[-1]) if covered else 0,
        **{key: round(value, 3) for key, value in figures.items()},
        "failed": code != 0 or not done or int(done[1]) < runs,
    }
    if found["failed"]:
        found["folder"] = str(folder)
    print(f"{name}: {json.dumps(found)}", file=sys.stderr)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; none: all")
    parser.add_argument("--runs", type=int, default=200_000)
    parser.add_argument("--jobs", type=int, default=1, help="targets at once")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child, arguments.folder, arguments.runs, arguments.seed)
        return 0
    names = arguments.targets or list(TARGETS)
    if unknown := set(names) - set(TARGETS):
        parser.error(f"there is no target {', '.join(sorted(unknown))}")
    with ThreadPoolExecutor(arguments.jobs) as pool:
        found = list(pool.map(lambda name: fuzz(name, arguments.runs, arguments.seed), names))
    print(json.dumps(dict(zip(names, found, strict=True)), indent=1))
    return 1 if any(one["failed"] for one in found) else 0


if __name__ == "__main__":
    raise SystemExit(main())
