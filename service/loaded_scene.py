"""A scene in memory with the tools bound to it: renderer, matcher, and what estimators prepare for it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import BackendMissing, InvalidImage, SceneNotFound
from service.estimators import ESTIMATORS
from service.interfaces import ImageMatcher, Matcher, Rasterizer, Tools
from service.matchers import MATCHERS
from service.pose.features.unknown_background import WHITE, has_white_border, shows_background
from service.pose.retrieval.index import ViewIndex
from service.pose.training_photos.digest import DIGEST, PhotoDigest, TrainingPhoto, digest_of, scene_key
from service.pose.training_photos.digest_file import DIGEST_FILE, read_digest
from service.render import RASTERIZERS
from service.scene_formats import load_scene
from service.scene_formats.cache import entry_of, mapped_scene, release
from service.scene_formats.manifest import told_by_manifest
from service.scene_formats.training_files import training_photo_path
from service.searched_scene import renderer_of, searched_scene
from service.types import GaussianScene, Query

log = logging.getLogger(__name__)
RASTERIZER_ORDER = ("gsplat_cuda", "cpu")
"""Where no rasterizer is named, the first one that can run here is used."""
DEFAULT_ESTIMATOR = "view_index"
DEFAULT_MATCHER = "xfeat"
VIEWS_CUT = (
    "the scene is larger than the {} views that its index may have: photos of some places may not be found; "
    "divide it into several scenes."
)
WHITE_ASSUMED = (
    "the scene's background colour is unknown: white is assumed, since the photo's border is white; "
    + told_by_manifest('"background": [red, green, blue]')
    + "."
)


@dataclass(slots=True)
class LoadedScene:
    """A scene in memory with the tools bound to it. Shared by all jobs on it; safe from several threads."""

    scene: GaussianScene
    """As its file has it."""
    rasterizer: Rasterizer
    """Of the scene that photos are localized in: without floaters that veil it."""
    matcher: Matcher
    """The gate's, too; beside an `image_matcher` it is the default one."""
    image_matcher: ImageMatcher | None = None
    cache_dir: Path | None = None
    """Folder in which view indexes and mapped scenes are kept between runs; None: nowhere."""
    skipped_rasterizers: str = ""
    """Why the rasterizer isn't an earlier one of RASTERIZER_ORDER."""
    warnings: tuple[str, ...] = ()
    """For every result."""
    without_floaters: GaussianScene | None = None
    """The scene that photos are localized in; None: it is all of `scene`."""
    photo_digest: PhotoDigest | None = None
    """Of its training photos; None: there is none."""
    _prepared: dict[str, Any] = field(default_factory=dict)
    _whole: Rasterizer | None = None
    _over_white: LoadedScene | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def load(
        cls,
        folder: Path,
        *,
        cache_dir: Path | None = None,
        rasterizer: str | None = None,
        matcher: str = DEFAULT_MATCHER,
    ) -> LoadedScene:
        """Read a scene folder (or a bare scene file) and bind tools to it.

        The digest of training photos is read where there is one. Raises SceneError, UnknownName, and BackendMissing if
        the rasterizer that was named can't run.
        """
        scene = mapped_scene(folder, cache_dir) if cache_dir else load_scene(folder)
        entry = entry_of(scene)
        loaded = cls.of(scene, cache_dir=cache_dir, rasterizer=rasterizer, matcher=matcher, entry=entry)
        if (folder / DIGEST_FILE).is_file():
            loaded.photo_digest = read_digest(folder / DIGEST_FILE, scene_key(scene))
        release(scene)  # the rasterizer has its own arrays
        return loaded

    @classmethod
    def of(
        cls,
        scene: GaussianScene,
        *,
        cache_dir: Path | None = None,
        rasterizer: str | None = None,
        matcher: str = DEFAULT_MATCHER,
        entry: Path | None = None,
    ) -> LoadedScene:
        """Bind tools to a scene in memory. Raises UnknownName, and BackendMissing as `load`.

        `entry` is the cache's folder that this very scene is mapped from: what is derived from its Gaussians is kept
        there. None of a scene that was changed in memory.
        """
        MATCHERS.load(matcher)  # an unknown one is told before the scene is packed
        searched = searched_scene(scene, entry)
        renderer, skipped_rasterizers, warnings = _renderer(searched, entry, rasterizer)
        features = images = _matcher(matcher, renderer)
        if isinstance(images, ImageMatcher):
            # Views are retrieved by features of single images, which a matcher of pairs does not have.
            features = _matcher(DEFAULT_MATCHER, renderer)
        else:
            # It extracts features, which every method can use.
            images = None
        part = None if searched is scene else searched
        return cls(scene, renderer, features, images, cache_dir, skipped_rasterizers, warnings, part)

    @property
    def searched(self) -> GaussianScene:
        """The scene that photos are localized in."""
        return self.without_floaters or self.scene

    @property
    def nbytes(self) -> int:
        """Memory of the scene and its renderer; a mapped scene's is the kernel's to take back."""
        whole = 0 if self._whole is None else self._whole.nbytes
        return self.scene.nbytes + self.rasterizer.nbytes + whole

    def for_display(self) -> Rasterizer:
        """Return a rasterizer of the whole scene, floaters included, made when it is first needed."""
        if self.without_floaters is None:
            return self.rasterizer
        with self._lock:
            if self._whole is None:
                self._whole = self.rasterizer.of(self.scene)
            return self._whole

    def prepare(self, estimator: str) -> Any:
        """Return what the estimator prepares for this scene (e.g. its view index), made once."""
        prepared = self.usable(estimator)
        if not isinstance(prepared, ViewIndex):
            return prepared
        whole = prepared.whole.result() if prepared.whole else prepared
        with self._lock:
            if self._prepared[estimator] is not whole:
                self._keep(estimator, whole)
        return whole

    def usable(self, estimator: str) -> Any:
        """Return what the estimator has prepared for this scene by now: of a large index at least its first part, which
        is made if need be."""
        with self._lock:
            if estimator not in self._prepared:
                self._make(estimator)
        return self.prepared(estimator)

    def _make(self, estimator: str) -> None:
        make = getattr(ESTIMATORS.load(estimator), "prepare", None)
        if make is None:
            self._prepared[estimator] = None
            return
        # A seed of its own: what a scene has prepared must not depend on the photo that came first.
        tools = Tools(self.searched, self.rasterizer, self.matcher, np.random.default_rng(0), None)
        self._keep(estimator, make(tools, self.cache_dir))

    def _keep(self, estimator: str, prepared: Any) -> None:
        self._prepared[estimator] = prepared
        if isinstance(prepared, ViewIndex) and prepared.whole:
            return
        if isinstance(prepared, ViewIndex) and prepared.is_cut:
            self.warnings += (VIEWS_CUT.format(len(prepared.views)),)
        # It was read through for the index; from now on the renderer's copy is used.
        release(self.scene)

    def prepared(self, estimator: str) -> Any:
        """Return what the estimator has prepared by now; None as long as it hasn't: nothing is made or waited for."""
        prepared = self._prepared.get(estimator)
        return prepared.latest() if isinstance(prepared, ViewIndex) else prepared

    def digest_photos(self, folder: Path, progress: Callable[[int, int], None] | None = None) -> PhotoDigest:
        """Return the digest of the training photos that lie in the scene's folder. Raises SceneNotFound."""
        cameras = self.scene.cameras[:: max(1, -(-len(self.scene.cameras) // DIGEST.max_photos))]
        photos = []
        for camera in cameras:
            path = training_photo_path(folder, camera.name)
            try:
                data = None if path is None else path.read_bytes()
                read = data and TrainingPhoto.read(camera, data, self.scene.info.background_rgb, self.matcher)
            except (InvalidImage, OSError) as error:
                log.warning("the training photo %s can't be read and is left out (%s)", camera.name, error)
                continue
            if read:
                photos.append(read)
        if not photos:
            raise SceneNotFound(
                "no photo of a training camera lies there.",
                where=str(folder),
                hint="Put them where the camera file says, or in a folder 'images' beside it.",
            )
        found = digest_of(photos, self.scene, self.rasterizer, progress)
        if found is None:
            raise SceneNotFound(
                f"no point was matched in three of the {len(photos)} training photos.",
                where=str(folder),
                hint="Check that the photos are those of the camera file, without distortion.",
            )
        return found

    def as_seen_by(self, query: Query) -> LoadedScene:
        """Return this scene, over white where its background is unknown, shows, and is white in the photo.

        The first such photo has the scene's view index made again, over white.
        """
        info = self.scene.info
        if info.background_is_known or info.background_rgb == WHITE:
            return self
        if not has_white_border(query.rgb, query.valid_mask):
            return self
        index = self.usable(DEFAULT_ESTIMATOR)
        with self._lock:
            # Whether the background shows at all is asked of the views once: a room hides it everywhere.
            if self._over_white is None:
                shown = shows_background(self.rasterizer, [view.camera for view in index.views])
                self._over_white = self._over(WHITE) if shown else self
            return self._over_white

    def _over(self, background_rgb: tuple[float, float, float]) -> LoadedScene:
        """Return the scene over an assumed background, in the same memory."""
        info = replace(self.scene.info, background_rgb=background_rgb)
        said = (*self.warnings, WHITE_ASSUMED)
        return replace(
            self, scene=replace(self.scene, info=info),
            without_floaters=self.without_floaters and replace(self.without_floaters, info=info),
            rasterizer=self.rasterizer.over(background_rgb), warnings=said,
            _prepared={}, _whole=None, _over_white=None, _lock=threading.Lock(),
        )  # fmt: skip


def choose_rasterizer() -> tuple[str, str]:
    """Return the rasterizer for scenes that name none, and why it isn't an earlier one of RASTERIZER_ORDER."""
    reasons = []
    for name in RASTERIZER_ORDER:
        reason = RASTERIZERS.missing(name)
        if reason is None:
            return name, "; ".join(reasons)
        reasons.append(f"{name}: {reason}")
    raise BackendMissing("; ".join(reasons), where="render")


def _matcher(name: str, renderer: Rasterizer) -> Any:
    """Return the matcher, on the renderer's device where it can be there."""
    module = MATCHERS.load(name)
    create_on = getattr(module, "create_on", None)
    return create_on(renderer.tensor_device) if create_on else module.create()


def _renderer(searched: GaussianScene, entry: Path | None, name: str | None) -> tuple[Rasterizer, str, tuple[str, ...]]:
    """Return the rasterizer, why it isn't an earlier one of RASTERIZER_ORDER, and what results should warn of."""
    if name:
        return renderer_of(searched, entry, name), "", ()
    name, skipped_rasterizers = choose_rasterizer()
    try:
        return renderer_of(searched, entry, name), skipped_rasterizers, ()
    except BackendMissing as error:  # the GPU's memory may be full
        last = RASTERIZER_ORDER[-1]
        if name == last:
            raise
        return renderer_of(searched, entry, last), str(error), (f"rendered with {last}: {error}",)
