"""Data sets in their published layouts: test photos with true cameras, and training cameras.

    nerf_synthetic  transforms_train.json, transforms_test.json (Blender); transparent photos over white
    llff            poses_bounds.npy and images*/; every eighth photo by name is a test photo
    mipnerf360      sparse/0 (COLMAP) and images*/; likewise
    deep_blending   sparse/0 and images/; likewise
    nerfstudio      transforms.json; its test_filenames, else a tenth of the photos, evenly spread
    scene           our scene folder, see `find_photos`

The trained scene is in the same folder or in another one, in the data set's world frame. Where photos come in several
sizes (images, images_2, ...), the smallest with a long side of 800 px or more are taken: the size of the paper's
supplement, at which scenes of these data sets are usually trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from service.bench.bench_photos import HOLD_OUT_EVERY, BenchPhoto, find_photos, moved_camera
from service.errors import CorruptScene, InvalidImage, InvalidPrior, SceneNotFound, UnknownName
from service.photos.images import photo_size
from service.scene_formats.colmap import read_cameras
from service.scene_formats.layouts import COLMAP_FOLDER
from service.scene_formats.manifest import MANIFEST, read_manifest
from service.scene_formats.nerfstudio import TransformsFile
from service.types import Camera, Intrinsics, NamedCamera, Pose

WHITE = (1.0, 1.0, 1.0)
NERFSTUDIO_TRAINING_SHARE = 0.9
"""Of the photos without a split; nerfstudio's default."""
MIN_LONG_SIDE_PX = 800
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".heic")
OPENCV_FROM_LLFF = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""LLFF's camera axes are down, right, backward."""


@dataclass(frozen=True, slots=True)
class DataSet:
    """Test photos and training cameras of a data set."""

    layout: str
    test: tuple[BenchPhoto, ...]
    """With their true cameras in the world frame."""
    training: tuple[NamedCamera, ...] | None
    """In the scene file's frame; None: the scene folder's, without the test photos."""
    background_rgb: tuple[float, float, float] | None = None
    """Given by the layout; None: the scene's."""

    @property
    def test_names(self) -> list[str]:
        """Names of the views whose cameras must not be among the scene's."""
        return [name for photo in self.test for name in photo.names]


@dataclass(frozen=True, slots=True)
class _Photo:
    file: Path
    camera: NamedCamera


def read_data_set(folder: Path, layout: str = "auto", scene: Path | None = None) -> DataSet:
    """Return the data set in a folder; `scene` is the folder or file of its trained scene.

    Raises UnknownName, SceneError.
    """
    if layout not in ("auto", *LAYOUTS):
        raise UnknownName(f"unknown layout '{layout}'; known: auto, {', '.join(LAYOUTS)}.", where="layout")
    if folder.is_file():
        raise SceneNotFound("a scene file has no photos.", where=str(folder), hint="Name the data set: --data FOLDER.")
    if not folder.is_dir():
        raise SceneNotFound("no such folder.", where=str(folder))
    if layout == "auto":
        layout = detect_layout(folder)
    if layout == "scene":
        return DataSet(layout, tuple(find_photos(folder)), None)
    test, training = LAYOUTS[layout](folder)
    if not test:
        raise SceneNotFound(f"there are no test photos in layout '{layout}'.", where=str(folder))
    # The manifest moves the scene, and the true poses must move with it.
    place = scene if scene is not None and scene.is_dir() else folder
    world_from_scene = read_manifest(place).world_from_scene
    transparent = layout == "nerf_synthetic"
    photos = [
        BenchPhoto(p.camera.name, p.file, moved_camera(p.camera.camera, world_from_scene), flatten=transparent)
        for p in test
    ]
    background = WHITE if transparent else None
    return DataSet(layout, tuple(photos), tuple(p.camera for p in training), background)


def detect_layout(folder: Path) -> str:
    """Return a folder's layout by the files in it. Raises SceneNotFound."""
    has = {name: (folder / name).exists() for name in ("truth.json", MANIFEST, "poses_bounds.npy", "transforms.json")}
    if has["truth.json"] or has[MANIFEST]:
        return "scene"
    if (folder / "transforms_train.json").is_file() and (folder / "transforms_test.json").is_file():
        return "nerf_synthetic"
    # Mip-NeRF 360 ships both, Deep Blending only COLMAP's model.
    if (folder / COLMAP_FOLDER).is_dir() and not has["transforms.json"]:
        return "mipnerf360" if has["poses_bounds.npy"] else "deep_blending"
    if has["poses_bounds.npy"]:
        return "llff"
    if has["transforms.json"]:
        return "scene"
    raise SceneNotFound(f"no layout of a data set; known: {', '.join(LAYOUTS)}.", where=str(folder))


def _nerf_synthetic(folder: Path) -> tuple[list[_Photo], list[_Photo]]:
    return tuple(  # type: ignore[return-value]
        _from_transforms(TransformsFile.open(folder / f"transforms_{part}.json"), None) for part in ("test", "train")
    )


def _nerfstudio(folder: Path) -> tuple[list[_Photo], list[_Photo]]:
    file = TransformsFile.open(folder / "transforms.json")
    names, listed = sorted(file.frames), file.split("test")
    if listed is None:
        count = int(np.ceil(NERFSTUDIO_TRAINING_SHARE * len(names)))
        # As nerfstudio's own parser splits, or test photos would be among those it trained on.
        kept = {names[i] for i in np.linspace(0, len(names) - 1, count, dtype=int)}
        return _from_transforms(file, [n for n in names if n not in kept]), _from_transforms(file, sorted(kept))
    return _from_transforms(file, listed), _from_transforms(
        file, [n for n in file.training_photos() if n not in listed]
    )


def _from_transforms(file: TransformsFile, names: Sequence[str] | None) -> list[_Photo]:
    folder = file.path.parent
    manifest = read_manifest(folder)
    return [
        _Photo(file.photo_file(name) or folder / name, file.camera(name, manifest)) for name in names or file.frames
    ]


def _llff(folder: Path) -> tuple[list[_Photo], list[_Photo]]:
    """Read rows of 17 numbers: a 3 x 5 matrix (camera axes, position, height-width-focal), near and far."""
    path = folder / "poses_bounds.npy"
    try:
        rows = np.load(path, allow_pickle=False)
        if rows.ndim != 2 or rows.shape[1] != 17:
            raise ValueError(f"its shape is {rows.shape}, not (photos, 17)")
    except (ValueError, OSError, EOFError) as error:
        raise CorruptScene(f"not LLFF's poses: {error}.", where=path.name) from None
    files = _photo_files(folder, len(rows))
    photos = [_Photo(file, _llff_camera(file, row[:15].reshape(3, 5))) for file, row in zip(files, rows, strict=True)]
    return _split_by_name(photos)


def _llff_camera(file: Path, values: Float64[np.ndarray, "3 5"]) -> NamedCamera:
    matrix = np.eye(4)
    matrix[:3, :3] = values[:, :3] @ OPENCV_FROM_LLFF.T
    matrix[:3, 3] = values[:, 3]
    height, width, focal = values[:, 4]
    try:
        camera = Intrinsics(int(width), int(height), focal, focal, width / 2, height / 2)
        return NamedCamera(file.name, Camera(_resized_to(file, camera), Pose(matrix)))
    except InvalidPrior as error:
        raise CorruptScene(str(error), where=f"poses_bounds.npy, {file.name}") from None


def _colmap(folder: Path) -> tuple[list[_Photo], list[_Photo]]:
    cameras = read_cameras(folder / COLMAP_FOLDER, lambda name: True)
    # By stem, as reduced copies may have another suffix than the model's names.
    files = {file.stem: file for file in _photo_files(folder, None)}
    photos = []
    for named in cameras:
        file = files.get(Path(named.name).stem, folder / "images" / named.name)
        camera = Camera(_resized_to(file, named.camera.intrinsics), named.camera.pose)
        photos.append(_Photo(file, NamedCamera(named.name, camera)))
    return _split_by_name(photos)


def _split_by_name(photos: list[_Photo]) -> tuple[list[_Photo], list[_Photo]]:
    """Split into test and training photos: every eighth by name, from the first on, is a test photo."""
    return photos[::HOLD_OUT_EVERY], [p for i, p in enumerate(photos) if i % HOLD_OUT_EVERY]


def _photo_files(folder: Path, count: int | None) -> list[Path]:
    """Return the photos of the smallest sufficient size, by name. Raises SceneNotFound, CorruptScene."""
    sizes = {}
    for place in sorted(folder.glob("images*")):
        files = sorted(p for p in place.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES) if place.is_dir() else []
        if files and count in (None, len(files)):
            sizes[max(_size_of(files[0]))] = files
    if not sizes:
        number = "" if count is None else f"{count} "
        raise SceneNotFound(f"no images folder with {number}photos found.", where=str(folder))
    enough = [size for size in sizes if size >= MIN_LONG_SIDE_PX]
    return sizes[min(enough) if enough else max(sizes)]


def _resized_to(file: Path, intrinsics: Intrinsics) -> Intrinsics:
    # The poses' file states the intrinsics of the largest size.
    return intrinsics.resized(*_size_of(file))


def _size_of(file: Path) -> tuple[int, int]:
    try:
        return photo_size(file.read_bytes())
    except (InvalidImage, OSError) as error:
        raise CorruptScene(f"the photo has no size: {error}", where=str(file.name)) from None


LAYOUTS: dict[str, Callable[[Path], tuple[list[_Photo], list[_Photo]]]] = {
    "nerf_synthetic": _nerf_synthetic,
    "llff": _llff,
    "mipnerf360": _colmap,
    "deep_blending": _colmap,
    "nerfstudio": _nerfstudio,
    "scene": lambda folder: ([], []),
}
"""Name -> function that returns test and training photos, in the scene file's frame."""
