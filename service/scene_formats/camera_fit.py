"""Decide how a scene's training cameras are to be understood: as their file is, corrected, or not at all.

The cameras are looked through as they are (`camera_evidence`). Only where that doesn't fit, or another file of the
folder states a transform, the candidates of `frame_candidates` are compared: coarsely, then the best ones finely.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.geometry import so3_exp
from service.scene_formats.camera_evidence import EVIDENCE, Evidence, EvidenceConfig, Photo, Points, evidence, points_of
from service.scene_formats.camera_parts import PARTS, Parts
from service.scene_formats.frame_candidates import PLAIN, CameraFile, Candidate, candidates
from service.scene_formats.gaussians import RawGaussians
from service.types import NamedCamera

PhotoOf = Callable[[NamedCamera], Photo | None]
"""Returns a camera's photo, where it is at hand."""
COARSE = EvidenceConfig(points=6_000, cameras=6, cells=24)
FINE = EvidenceConfig(points=60_000, cameras=12)
FINEST = EvidenceConfig(points=120_000, cameras=24, cells=128)
"""A cell for each pixel of the small photos: with 96, normalizations 0.5 degrees apart are ranked by chance (chair)."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FitConfig:
    """What is enough evidence."""

    least_correlation: float = 0.2
    """With the photos; right cameras have 0.23 (a museum's reflecting glass case) to 0.8."""
    alike: float = 0.03
    """Correlations that differ by less are compared again, more finely."""
    same: float = 1e-4
    simple: float = 0.015
    """Of those the likelier candidate is taken where they differ by less: of normalizations, and of what is simpler."""
    clear_correlation: float = 0.33
    """Of the cameras as they are, coarsely: nothing else is tried; and what anything else needs."""
    tie: float = 0.015
    """Of correlations as coarse as those; of right cameras' disturbances the best was 0.009 better (fox)."""
    plausible: float = 0.3
    """Geometry of cameras without photos that see a scene; wrong ones have 0 to 0.25 in rooms."""
    alike_share: float = 0.9
    """Of the best geometry: it says no more, and the likelier candidate is taken."""
    distinct: float = 0.7
    """Candidates with a geometry of less than this share of the best are excluded by it."""
    least_cameras: int = 4
    least_gaussians: int = 1000
    """With fewer nothing is said about cameras: they stay as their file has them."""
    turn_deg: float = 5.0
    stretch: float = 1.15
    """Placements that differ by so much must fit less."""
    finalists: int = 8
    coarse: EvidenceConfig = COARSE
    fine: EvidenceConfig = FINE
    finest: EvidenceConfig = FINEST


FIT = FitConfig()


@dataclass(frozen=True, slots=True)
class CameraFit:
    """How the cameras are placed."""

    cameras: tuple[NamedCamera, ...]
    """In the scene file's frame; none where nothing fits."""
    file_from_cameras: Float64[np.ndarray, "4 4"]
    decided_by: str
    """In words, with what was corrected."""
    verified: bool
    """Photos or geometry exclude the other candidates."""
    warnings: tuple[str, ...] = ()
    is_doubtful: bool = False
    """They were compared with the scene, and may be elsewhere all the same."""


def fitted(
    raw: RawGaussians,
    file: CameraFile,
    photo_of: PhotoOf,
    background_rgb: tuple[float, float, float] | None = None,
    config: FitConfig = FIT,
) -> CameraFit:
    """Return the cameras where they fit the Gaussians.

    `raw` is checked, in the scene file's frame; `background_rgb` is None where no file says it.
    """
    if len(file.cameras) < config.least_cameras or len(raw.means) < config.least_gaussians:
        return CameraFit(file.cameras, np.eye(4), "as the camera file has them; too few to check", False)
    trial = _Trial(raw, file, photo_of, background_rgb, config)
    fit = None if file.stated else _as_they_are(trial, config)
    if fit and fit.verified:
        return fit
    if len(file.cameras) < PARTS.least_cameras:
        return fit or _corrected(trial, file, config)
    # A choice of the cameras sees little of a large scene, right or not.
    trial.divide()
    in_parts = None if file.stated else _as_they_are(trial, config)
    trial.unite()
    if fit := in_parts or fit:
        return fit
    whole = _corrected(trial, file, config)
    if whole.verified:
        return whole
    trial.divide()
    corrected = _corrected(trial, file, config)
    return corrected if corrected.cameras else whole


def _as_they_are(trial: _Trial, config: FitConfig) -> CameraFit | None:
    """Return the cameras as their file has them, where that fits well enough to try nothing else."""
    as_is = Candidate("")
    first = trial.evidence(as_is, EVIDENCE)
    _log.info("cameras as they are: %s", first)
    if first.correlation is None:
        return trial.fit(as_is, first, verified=first.surrounded) if first.geometry >= config.plausible else None
    if first.correlation >= config.clear_correlation and trial.is_peak(as_is, first, EVIDENCE, config.tie):
        return trial.fit(as_is, first, verified=True)
    return None


def _corrected(trial: _Trial, file: CameraFile, config: FitConfig) -> CameraFit:
    """Return the cameras as the best candidate has them; without cameras where none fits."""
    found = [(trial.evidence(c, config.coarse), c) for c in candidates(file)]
    return (_by_geometry if found[0][0].correlation is None else _by_photos)(trial, found, config)


def _by_photos(trial: _Trial, coarse: list[tuple[Evidence, Candidate]], config: FitConfig) -> CameraFit:
    order = sorted(range(len(coarse)), key=lambda i: -coarse[i][0].score)
    # In the order of the candidates, the likelier ones first.
    finalists = [coarse[i][1] for i in sorted({0, *order[: config.finalists]})]
    finer = [(trial.evidence(c, config.fine), c) for c in finalists]
    leading, leader = max(finer, key=lambda one: one[0].score)
    best = leading.score
    compared = {id(c) for found, c in finer if found.score >= best - config.alike}
    # A coarse look can't rank normalizations that hardly differ: all of them are compared.
    compared |= {id(c) for _, c in coarse if c.is_normalization and trial.same(c, leader)}
    alike = [(trial.evidence(c, config.finest), c) for _, c in coarse if id(c) in compared]
    most = max(found.score for found, _ in alike)
    # Normalizations are many: one of them may be better by chance than what is simple and right.
    chosen = next(
        c for found, c in alike if found.score >= most - (config.same if c.is_normalization else config.simple)
    )
    fine = next((found for found, c in finer if c is chosen), None) or trial.evidence(chosen, config.fine)
    is_clear = not chosen.name or chosen.is_measured or fine.score >= config.clear_correlation
    if is_clear and trial.is_peak(chosen, fine, config.fine, config.tie):
        return trial.fit(chosen, fine, verified=True)
    first = finer[0][0]
    if first.geometry >= config.plausible and first.score >= best - config.alike:
        return trial.fit(finer[0][1], first, verified=False)
    return trial.none("their photos", _ALIGN)


def _by_geometry(trial: _Trial, coarse: list[tuple[Evidence, Candidate]], config: FitConfig) -> CameraFit:
    order = sorted(range(len(coarse)), key=lambda i: -coarse[i][0].geometry)
    likely = range(trial.likely)
    finalists = [coarse[i][1] for i in sorted({*likely, *order[: 2 * config.finalists]})]
    found = [(trial.evidence(c, config.fine), c) for c in finalists]
    best = max(evidence.geometry for evidence, _ in found)
    if best < config.plausible:
        return trial.none("the Gaussians in front of them")
    # What the trainer itself wrote needs no better evidence than the rest.
    least = max(config.plausible, config.distinct * best)
    wrote = [(e, c) for e, c in found if c.is_model_frame and e.geometry >= least]
    if wrote:
        evidence, chosen = wrote[0]
        return trial.fit(chosen, evidence, verified=all(trial.same(chosen, other) for _, other in wrote))
    evidence, chosen = next((e, c) for e, c in found if e.geometry >= config.alike_share * best)
    rivals = [c for e, c in found if e.geometry >= config.distinct * evidence.geometry]
    return trial.fit(chosen, evidence, verified=all(trial.same(chosen, rival) for rival in rivals))


class _Trial:
    """Looks at one scene with one camera file, as each candidate understands it."""

    def __init__(
        self,
        raw: RawGaussians,
        file: CameraFile,
        photo_of: PhotoOf,
        background_rgb: tuple[float, float, float] | None,
        config: FitConfig,
    ) -> None:
        self._raw, self._file, self._photo_of = raw, file, photo_of
        self._background_rgb, self._config = background_rgb, config
        self._points: dict[int, Points] = {}
        self._photos: dict[str, Photo | None] = {}
        self._parts: Parts | None = None
        self.likely = 2 * len(file.stated) + len(PLAIN)
        """The first candidates: without a change, stated by files, without a change of the world."""

    def divide(self) -> None:
        """Ask for evidence part by part from now on."""
        points = points_of(self._raw, self._background_rgb, replace(EVIDENCE, points=PARTS.points))
        self._parts = Parts(points, self._file, self._photo)

    def unite(self) -> None:
        """Ask for evidence of the whole scene again."""
        self._parts = None

    def evidence(self, candidate: Candidate, config: EvidenceConfig) -> Evidence:
        if self._parts:
            return self._parts.evidence(candidate, config)
        if config.points not in self._points:
            self._points[config.points] = points_of(self._raw, self._background_rgb, config)
        # Every so many: neighbours see the same.
        chosen = self._file.cameras[:: -(-len(self._file.cameras) // config.cameras)]
        placed = [named.camera for named in candidate.placed(chosen, self._file)]
        return evidence(self._points[config.points], placed, [self._photo(named) for named in chosen], config)

    def is_peak(self, candidate: Candidate, found: Evidence, config: EvidenceConfig, tie: float = 0.0) -> bool:
        """Whether the photos fit, and no better by more than `tie` where the cameras are turned and moved."""
        if found.score < self._config.least_correlation:
            return False
        middle = self._parts.middle if self._parts else self._points[config.points].middle
        return all(
            self.evidence(candidate.then(about(middle, turn, stretch)), config).score < found.score + tie
            for turn, stretch in _disturbances(self._config)
        )

    def _photo(self, named: NamedCamera) -> Photo | None:
        if named.name not in self._photos:
            self._photos[named.name] = self._photo_of(named)
        return self._photos[named.name]

    def same(self, a: Candidate, b: Candidate) -> bool:
        """Whether two candidates place the cameras at nearly the same poses."""
        chosen = self._file.cameras[:: -(-len(self._file.cameras) // EVIDENCE.cameras)]
        one, other = (np.array([n.camera.pose.world_from_camera for n in c.placed(chosen, self._file)]) for c in (a, b))
        spread = np.linalg.norm(one[:, :3, 3] - one[:, :3, 3].mean(0), axis=1).max()
        moved = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max()
        return bool(moved <= 0.1 * spread and ((one[:, :3, 2] * other[:, :3, 2]).sum(1) > 0.98).all())

    def fit(self, candidate: Candidate, found: Evidence, *, verified: bool) -> CameraFit:
        placed = tuple(candidate.placed(self._file.cameras, self._file))
        matrix = np.eye(4) if candidate.file_from_cameras is None else candidate.file_from_cameras
        by = "geometry" if found.correlation is None else f"photos (correlation {found.correlation:.2f})"
        said = () if not candidate.name else (_CORRECTED.format(candidate.name, by),)
        return CameraFit(
            placed, matrix, f"{candidate.name or 'as the camera file has them'}, by {by}", verified, said, not verified
        )

    def none(self, by: str, hint: str = "") -> CameraFit:
        return CameraFit((), np.eye(4), f"nothing fits, by {by}", False, (_LEFT_OUT.format(by) + hint,))


def _disturbances(config: FitConfig) -> Iterator[tuple[Float64[np.ndarray, "3 3"], float]]:
    """Yield turns about each axis and changes of scale, small but larger than what the cells resolve."""
    for axis in np.eye(3):
        for sign in (-1, 1):
            yield so3_exp(np.radians(sign * config.turn_deg) * axis), 1.0
    yield np.eye(3), config.stretch
    yield np.eye(3), 1 / config.stretch


def about(
    point: Float64[np.ndarray, "3"], rotation: Float64[np.ndarray, "3 3"], scale: float
) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity that turns and scales about a point."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = point - matrix[:3, :3] @ point
    return matrix


_CORRECTED = "the training cameras don't fit the scene as their file has them, but with: {}; decided by {}."
_LEFT_OUT = (
    "the training cameras fit the scene in no known frame or convention, by {}: they are left out, and views are "
    "placed by the scene itself."
)
_ALIGN = (
    " Another rotation, shift and scale is found by localizing the photos: a service does it by itself once the scene "
    "is loaded, `splatfix scenes align` without one."
)
