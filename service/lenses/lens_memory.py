"""The memory of lenses: recalls what is known of a photo's lens, and learns from the photo's answer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from service.lenses.lens_estimate import LENS_MEMORY, Components, LensEstimate, LensMeasurement, Viewpoint, updated
from service.lenses.lens_key import lens_key
from service.lenses.lens_store import LensStore
from service.photos.camera_identity import CameraIdentity
from service.photos.intrinsics import ORIENTATIONS, oriented
from service.results import PoseEstimate, Status
from service.types import UNKNOWN_PRINCIPAL_POINT, Intrinsics, LensPrior

_INVERSE = {6: 8, 8: 6}
"""EXIF orientations that aren't undone by themselves."""
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL")
"""Camera models that an estimate can hold."""
_LEAST_INFORMATION = 0.5
"""Share of the posterior's information that must be the photo's own: the difference to the prior's is uncertain."""


@dataclass(frozen=True, slots=True)
class RecalledLens:
    """What is known of a photo's lens before the photo is localized: fixed when its job is accepted."""

    id: str
    """Of the lens' key."""
    intrinsics: Intrinsics
    """Approximate; of the upright photo in its full size."""
    prior: LensPrior
    """How certain they are."""
    photos: int
    """That were learnt from."""


class LensMemory:
    """Lenses of all owners. Safe to call from several threads."""

    def __init__(self, store: LensStore) -> None:
        self.store = store

    def recall(self, owner: str, camera_id: str | None, camera: CameraIdentity) -> RecalledLens | None:
        """Return the intrinsics and their prior by earlier photos of the owner; None if none was learnt from."""
        key = lens_key(owner, camera_id, camera)
        lens = self.store.find(key.id) if key else None
        if lens is None:
            return None
        focal_sigma, k1_sigma, *shift_sigmas = lens.estimate.prior_sigma()
        # A prior has one scale for both directions.
        shift_sigma = max(shift_sigmas)
        if _is_turned_unknown(camera):
            # The centre is assumed, from which the principal point lies in an unknown direction.
            shift_sigma = float(np.hypot(shift_sigma, np.hypot(*lens.estimate.mean[2:])))
        prior = LensPrior(focal_sigma, k1_sigma, min(shift_sigma, UNKNOWN_PRINCIPAL_POINT))
        return RecalledLens(lens.key.id, _intrinsics(lens.estimate, camera), prior, lens.estimate.photos)

    def learn(
        self,
        owner: str,
        camera_id: str | None,
        camera: CameraIdentity,
        recalled: RecalledLens | None,
        answer: PoseEstimate,
    ) -> bool:
        """Update the lens of a photo that was localized with `recalled` as its prior; return whether that was done.

        Only a sure answer that determines the focal length is learnt from. Raises StorageFailed.
        """
        key = lens_key(owner, camera_id, camera)
        found = measured(answer, camera, recalled) if key else None
        if key is None or found is None:
            return False
        # Inside of the store's transaction: two photos that end at once both count.
        self.store.change(key, lambda known: updated(known, found))
        return True


def measured(
    answer: PoseEstimate, camera: CameraIdentity, recalled: RecalledLens | None = None
) -> LensMeasurement | None:
    """Return a photo's own measurement of its lens; None where the answer isn't sure, or the lens wasn't estimated.

    An answer's estimate holds what its prior said: the information (inverse variance) of the prior is taken out again,
    lest what is recalled confirms itself.
    """
    verdict, intrinsics = answer.verdict, answer.intrinsics
    sure = verdict.status is Status.LOCALIZED and verdict.place_probability >= LENS_MEMORY.min_score
    if not sure or not verdict.focal_sigma or intrinsics.model not in _MODELS:
        return None
    value = _stored_values(intrinsics, camera)
    focal_sigma, k1_sigma, *shift_sigmas = verdict.correction_sigma
    # The larger one, for whichever way the photo is turned.
    sigma = [focal_sigma, k1_sigma, *2 * (max(shift_sigmas),)]
    if recalled is not None:
        value, sigma = _without_prior(value, sigma, _stored_values(recalled.intrinsics, camera), recalled.prior)
    if _is_turned_unknown(camera):
        # Turned the wrong way, the shift would be learnt with the opposite sign.
        value[2:], sigma[2:] = (0.0, 0.0), (math.inf, math.inf)
    if sigma[0] > LENS_MEMORY.max_focal_sigma:
        return None
    return LensMeasurement(_components(value), _components(sigma), _viewpoint(answer))


def _without_prior(
    value: list[float], sigma: list[float], assumed: list[float], prior: LensPrior
) -> tuple[list[float], list[float]]:
    """Return the evidence that turned a prior about the assumed values into a posterior; infinite sigmas: none."""
    posterior, centre = np.array(value), np.array(assumed)
    scale = np.array([prior.log_focal_scale, prior.k1_sigma, *2 * (prior.principal_point_scale,)])
    # A prior with heavy tails holds back the less the farther off the posterior is.
    distance = (posterior - centre) * [1, 0, 1, 1]
    whole, of_prior = np.array(sigma) ** -2, 1 / (scale**2 + distance**2)
    own = whole - of_prior
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = (whole * posterior - of_prior * centre) / own
        measures = own >= _LEAST_INFORMATION * whole
        return np.where(measures, evidence, posterior).tolist(), np.where(measures, own**-0.5, np.inf).tolist()


def _viewpoint(answer: PoseEstimate) -> Viewpoint:
    verdict = answer.verdict
    share = verdict.signals.get("sigma_share", 0.0)
    distance = math.inf
    # The gate's signal is the position's standard deviation over the distance.
    if verdict.covariance is not None and share > 0:
        distance = float(np.sqrt(np.trace(verdict.covariance[3:, 3:]))) / share
    return Viewpoint(answer.scene_sha256, answer.pose, distance)


def _is_turned_unknown(camera: CameraIdentity) -> bool:
    """Whether the photo is stored upright, so that the direction in which the camera's frame was turned is unknown."""
    return camera.height > camera.width


def _stored_values(upright: Intrinsics, camera: CameraIdentity) -> list[float]:
    """Return the components of a lens for intrinsics of the upright photo."""
    stored = oriented(upright, *ORIENTATIONS[_INVERSE.get(camera.orientation, camera.orientation)])
    long_side = stored.long_side
    shifts = (stored.cx - stored.width / 2) / long_side, (stored.cy - stored.height / 2) / long_side
    k1 = stored.distortion[0] if stored.distortion else 0.0
    return [math.log(stored.fx / long_side), k1, *shifts]


def _intrinsics(lens: LensEstimate, camera: CameraIdentity) -> Intrinsics:
    """Return a lens' intrinsics for the upright photo of a camera."""
    log_focal, k1, *shifts = lens.mean
    long_side = max(camera.width, camera.height)
    shift_x, shift_y = (0.0, 0.0) if _is_turned_unknown(camera) else shifts
    focal = math.exp(log_focal) * long_side
    stored = Intrinsics(
        camera.width,
        camera.height,
        focal,
        focal,
        camera.width / 2 + shift_x * long_side,
        camera.height / 2 + shift_y * long_side,
        "SIMPLE_RADIAL",
        (k1,),
        "approximate",
    )
    return oriented(stored, *ORIENTATIONS[camera.orientation])


def _components(values: list[float]) -> Components:
    log_focal, k1, shift_x, shift_y = values
    return log_focal, k1, shift_x, shift_y
