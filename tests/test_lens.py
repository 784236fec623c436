"""Approximate intrinsics, and the uncertainty of a pose: against planted truths, differences and simulations."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.errors import InvalidIntrinsics
from service.geometry import moved, pose_distance, project, se3_exp, se3_log, transformed
from service.interfaces import Frame
from service.photos.images import query_of
from service.photos.intrinsics import intrinsics_from
from service.pose.absolute_pose.unknown_lens import absolute_pose_unknown_lens, linearize_reprojection
from service.pose.features.rendered_views import to_uint8
from service.pose.refinement import covariance
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.refinement_config import REFINEMENT, UncertaintyConfig
from service.pose.refinement.uncertainty import pose_uncertainty
from service.types import NO_CORRECTION, Camera, Intrinsics, IntrinsicsCorrection, LensPrior, Pose
from tests.test_pose import LENS, PaintedWalls, photo_from, true_pose


def seen_through(lens: IntrinsicsCorrection, points_in_camera: np.ndarray) -> np.ndarray:
    """The points' pixels in LENS with this correction, by OpenCV's projection."""
    camera = LENS.corrected(lens)
    # OpenCV has the centre of the first pixel at (0, 0), but a pinhole's centre is where its intrinsics say.
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    distortion = np.array([lens.k1, 0.0, 0.0, 0.0])
    px, _ = cv2.projectPoints(points_in_camera, np.zeros(3), np.zeros(3), matrix, distortion)
    return px[:, 0]


def planted(
    seed: int, lens: IntrinsicsCorrection, flat: bool, wrong_share: float
) -> tuple[np.ndarray, np.ndarray, Pose]:
    """Matches with a pixel of noise, seen through `lens` beside LENS; some are wrong."""
    rng = np.random.default_rng(seed)
    pose = true_pose(seed)
    points = np.concatenate([rng.uniform(-1.3, 1.3, (150, 2)), rng.uniform(0.0, 0.0 if flat else 1.2, (150, 1))], 1)
    px = seen_through(lens, transformed(pose.camera_from_world, points)) + rng.normal(0, 0.3, (150, 2))
    wrong = rng.random(150) < wrong_share
    px[wrong] = rng.uniform([0, 0], [LENS.width, LENS.height], (wrong.sum(), 2))
    return px, points, pose


@pytest.mark.parametrize(("factor", "k1"), [(0.45, -0.02), (0.8, 0.1), (1.0, -0.1), (1.15, 0.0), (2.2, 0.0)])
def test_focal_length_and_distortion_are_found_among_wrong_matches(factor: float, k1: float) -> None:
    px, points, pose = planted(3, IntrinsicsCorrection(factor, k1=k1), flat=False, wrong_share=0.4)
    found = absolute_pose_unknown_lens(px, points, LENS, LensPrior(0.5, k1_sigma=0.1), 2.0)
    assert found is not None
    assert found.correction.focal_factor == pytest.approx(factor, rel=0.02)
    assert found.correction.k1 == pytest.approx(k1, abs=0.03)
    angle, distance = pose_distance(found.pose, pose)
    assert angle < 1.5
    assert distance < 0.03 * 3.2
    assert found.num_inliers >= 75


def test_the_prior_decides_where_a_wall_seen_straight_on_leaves_the_focal_length_open() -> None:
    """A plane parallel to the image: any focal length fits as well with another distance."""
    rng = np.random.default_rng(0)
    pose = Pose(np.diag([1.0, -1.0, -1.0, 1.0]) + np.array([[0] * 4, [0] * 4, [0, 0, 0, 3.0], [0] * 4]))
    points = np.concatenate([rng.uniform(-1.2, 1.2, (100, 2)), np.zeros((100, 1))], 1)
    px = project(transformed(pose.camera_from_world, points), LENS.corrected(IntrinsicsCorrection(1.3)))
    found = absolute_pose_unknown_lens(px, points, LENS, LensPrior(0.1), 2.0)
    assert found is not None
    assert found.num_inliers == 100
    assert found.correction.focal_factor == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("column", range(10))
def test_linearized_is_the_derivative_by_differences(column: int) -> None:
    px, points, pose = planted(1, NO_CORRECTION, flat=False, wrong_share=0.0)
    at = IntrinsicsCorrection(1.1, 0.02, -0.01, k1=-0.08)
    jacobian, _, _ = linearize_reprojection(px, points, LENS, pose, at)
    step = np.zeros(10)
    step[column] = 1e-6

    def seen(step: np.ndarray) -> np.ndarray:
        focal, k1, shift_x, shift_y = step[6:]
        lens = IntrinsicsCorrection(
            at.focal_factor * float(np.exp(focal)), at.shift_x + shift_x, at.shift_y + shift_y, at.k1 + k1
        )
        camera = pose.world_from_camera @ se3_exp(step[:6])
        return seen_through(lens, transformed(np.linalg.inv(camera), points))

    difference = (seen(step) - seen(-step)) / 2e-6
    assert np.allclose(jacobian[..., column], difference, rtol=1e-4, atol=1e-4)


def test_refinement_estimates_the_intrinsics_with_the_pose() -> None:
    truth, lens = true_pose(2), IntrinsicsCorrection(1.06, 0.008, -0.005)
    rgb = photo_from(truth, LENS.corrected(lens)).rgb
    pose, found = moved(truth, np.array([0.01, -0.01, 0.005, 0.02, 0.03, 0.1])), NO_CORRECTION
    for _ in range(4):
        camera = Camera(LENS.corrected(found), pose)
        frame = PaintedWalls().render([camera])[0]
        result = refine_photometric(rgb, frame, camera, Camera(LENS, pose), 3, found, LensPrior(0.5))
        pose, found = result.pose, result.correction
    assert found.focal_factor == pytest.approx(1.06, rel=0.004)
    assert found.shift_x == pytest.approx(0.008, abs=0.003)
    assert found.shift_y == pytest.approx(-0.005, abs=0.003)
    angle, distance = pose_distance(pose, truth)
    assert angle < 0.3
    assert distance < 0.015


def distorted_photo(pose: Pose, lens: IntrinsicsCorrection) -> np.ndarray:
    """The photo of a camera with this lens: a larger one without distortion, resampled by OpenCV."""
    camera = LENS.corrected(lens)
    margin = 60
    large = replace(
        camera,
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
    )
    rgb = photo_from(pose, large).rgb
    row, column = np.mgrid[: LENS.height, : LENS.width] + 0.5
    px = np.stack([column.ravel(), row.ravel()], 1)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    straight = cv2.undistortPoints(px, matrix, np.array([lens.k1, 0.0, 0.0, 0.0]), P=matrix)[:, 0] + margin - 0.5
    x, y = straight.T.reshape(2, LENS.height, LENS.width).astype(np.float32)
    return np.asarray(cv2.remap(rgb, x, y, cv2.INTER_CUBIC))


def bent(rgb: np.ndarray, soft_px: float, rng: np.random.Generator) -> np.ndarray:
    """The image as a model with faults shows it: its parts are shifted by a third of a pixel, neighbours alike."""
    height, width = rgb.shape[:2]
    shift = cv2.GaussianBlur(rng.normal(size=(height, width, 2)).astype(np.float32), (0, 0), soft_px)
    shift *= 0.3 / shift.std()
    row, column = np.mgrid[:height, :width].astype(np.float32)
    return cv2.remap(rgb, column + shift[..., 0], row + shift[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)


@pytest.mark.parametrize(
    ("soft_px", "noise", "least", "most"),
    [
        (0, 0.1, 2.0, 8.0),  # seen: 3.2; independent residuals need no quarters, whose moves exceed errors
        (8, 0.02, 4.0, 9.0),  # seen: 6.8
        (20, 0.02, 6.0, 14.0),  # seen: 10.3; alike over a third of the image: quarters are too small
    ],
)
def test_the_covariance_predicts_how_refinements_scatter(
    soft_px: float, noise: float, least: float, most: float
) -> None:
    """Against a simulation: many photos from one planted pose, each with noise and a bend of its own."""
    config = replace(REFINEMENT, uncertainty=UncertaintyConfig(min_variance_scale=0.0))
    truth = true_pose()
    camera = Camera(LENS, truth)
    frame = PaintedWalls().render([camera])[0]
    rng = np.random.default_rng(0)
    weighed = []
    for _ in range(60):
        image = bent(frame.rgb, soft_px, rng) if soft_px else frame.rgb
        photo = to_uint8((image + rng.normal(0, noise, image.shape)).astype(np.float32))
        pose = refine_photometric(photo, frame, camera, camera, 1).pose
        found = pose_uncertainty(photo, frame, camera, Camera(LENS, pose), None, config=config)
        assert found is not None
        assert np.abs(found.last_step).max() < 2e-4  # a hundredth of a pixel; seen: 1.2e-4
        assert np.linalg.eigvalsh(found.covariance).min() > 0
        twist = se3_log(pose.camera_from_world @ truth.world_from_camera)
        weighed.append(twist @ np.linalg.solve(found.covariance, twist))
    assert least < np.mean(weighed) < most, np.mean(weighed)


def test_what_no_pixel_determines_has_no_covariance() -> None:
    """Quarters that agree perfectly have no spread; a column of zeros has no inverse, and no finite spread."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(40, 10, 30))
    hessians = half @ np.swapaxes(half, 1, 2)
    places = np.stack(np.divmod(np.arange(40), 8), 1).astype(np.float64)
    assert covariance.jackknife_variance_scale(np.zeros((40, 10)), hessians, places, UncertaintyConfig()) == 0
    wanted = np.linalg.inv(hessians.sum(0))
    found = covariance.inverse_spd(hessians.sum(0))
    assert found is not None
    assert np.allclose(found, wanted, rtol=1e-9)
    hessians[:, 3] = hessians[:, :, 3] = 0.0
    assert covariance.inverse_spd(hessians.sum(0)) is None
    assert covariance.jackknife_variance_scale(np.zeros((40, 10)), hessians, places, UncertaintyConfig()) == np.inf


def test_the_spread_of_independent_parts_is_theirs() -> None:
    """Scores drawn with s times each cell's hessian as covariance; a quarter's removal exaggerates by a third."""
    rng = np.random.default_rng(1)
    half = rng.normal(size=(400, 10, 12))
    hessians = half @ np.swapaxes(half, 1, 2)
    places = np.stack(np.divmod(np.arange(400), 20), 1).astype(np.float64)
    found = []
    for _ in range(50):
        scores = np.sqrt(2.5) * (half @ rng.normal(size=(400, 12, 1)))[..., 0]
        # The unknowns were fitted: what is left of the scores adds up to nothing.
        scores -= hessians @ np.linalg.solve(hessians.sum(0), scores.sum(0))
        found.append(covariance.jackknife_variance_scale(scores, hessians, places, UncertaintyConfig()))
    assert np.mean(found) == pytest.approx(2.5 * 4 / 3, rel=0.1)


def test_the_last_step_measures_how_far_a_pose_is_off() -> None:
    truth = true_pose()
    off = np.array([0.004, -0.003, 0.002, 0.01, 0.005, -0.01])
    camera = Camera(LENS, moved(truth, off))
    found = pose_uncertainty(photo_from(truth).rgb, PaintedWalls().render([camera])[0], camera, camera, None)
    assert found is not None
    assert np.allclose(found.last_step, -off, atol=2e-3)


LENSES = [
    (NO_CORRECTION, False),
    (IntrinsicsCorrection(1.05), True),
    (IntrinsicsCorrection(0.97), True),
    (IntrinsicsCorrection(k1=-0.08), True),
    (IntrinsicsCorrection(1.0, 0.08, -0.05), True),
]


@pytest.mark.parametrize(("lens", "wrong"), LENSES)
def test_intrinsics_that_the_pixels_contradict(lens: IntrinsicsCorrection, wrong: bool) -> None:
    """The pose is the best one for the intrinsics given; the pixels still show the planted ones."""
    truth = true_pose(1)
    rgb = distorted_photo(truth, lens)
    pose = truth
    for _ in range(4):
        camera = Camera(LENS, pose)
        frame = PaintedWalls().render([camera])[0]
        pose = refine_photometric(rgb, frame, camera, camera, 3).pose
    found = pose_uncertainty(rgb, frame, camera, Camera(LENS, pose), None)
    assert found is not None
    assert bool(found.lens_fit and found.lens_fit.contradicts) == wrong
    if found.lens_fit and wrong:
        fit = found.lens_fit.correction
        assert fit.focal_factor == pytest.approx(lens.focal_factor, rel=0.01)
        assert fit.k1 == pytest.approx(lens.k1, abs=0.02)
        assert np.allclose([fit.shift_x, fit.shift_y], [lens.shift_x, lens.shift_y], atol=0.015)


@pytest.mark.parametrize(("turning", "seen"), [((0.0, 0.0), None), ((0.02, 0.0), 0), ((0.0, 0.02), 1)])
@pytest.mark.parametrize("prior", [None, LensPrior(0.15)])
def test_a_turn_while_the_rows_are_read_is_seen(
    turning: tuple[float, float], seen: int | None, prior: LensPrior | None
) -> None:
    """Each row is taken by a camera of its own, which has turned a little (rad per unit of normalized height)."""
    truth = true_pose(1)
    rgb = np.empty((LENS.height, LENS.width, 3), np.uint8)
    bands = 24
    for band in range(bands):
        rows = slice(band * LENS.height // bands, (band + 1) * LENS.height // bands)
        height = (0.5 * (rows.start + rows.stop) - LENS.cy) / LENS.fy
        sideways, up = np.array(turning) * height
        turned = moved(truth, np.array([up, -sideways, 0.0, 0.0, 0.0, 0.0]))
        rgb[rows] = photo_from(turned).rgb[rows]
    pose, correction = truth, NO_CORRECTION
    for _ in range(3):
        camera = Camera(LENS.corrected(correction), pose)
        frame = PaintedWalls().render([camera])[0]
        result = refine_photometric(rgb, frame, camera, Camera(LENS, pose), 3, correction, prior)
        pose, correction = result.pose, result.correction
    answer = Camera(LENS.corrected(correction), pose)
    found = pose_uncertainty(rgb, frame, camera, answer, prior, result=result)
    assert found is not None
    if seen is None:
        assert found.shutter is None
        return
    assert found.shutter is not None
    values = found.shutter.shear, found.shutter.stretch
    assert abs(values[seen]) > 2 * abs(values[1 - seen])
    # One step sees a part of it, the rest is in the pose.
    assert 0.005 < abs(values[seen]) < 0.03
    still = pose_uncertainty(frame_photo(frame), frame, camera, answer, prior)
    assert still is not None
    assert np.trace(found.covariance[:6, :6]) > 2 * np.trace(still.covariance[:6, :6])


def frame_photo(frame: Frame) -> np.ndarray:
    return to_uint8(frame.rgb)


def test_corrected_is_undone_by_nothing_but_its_opposite() -> None:
    lens = IntrinsicsCorrection(1.2, 0.01, -0.02)
    there = LENS.corrected(lens)
    back = there.corrected(IntrinsicsCorrection(1 / 1.2, -0.01, 0.02))
    assert np.allclose([back.fx, back.fy, back.cx, back.cy], [LENS.fx, LENS.fy, LENS.cx, LENS.cy])
    big = LENS.resized(2 * LENS.width, 2 * LENS.height).corrected(lens)
    assert np.allclose([big.fx, big.cx, big.cy], 2 * np.array([there.fx, there.cx, there.cy]))


def test_trust_is_read_and_checked() -> None:
    given = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
    assert intrinsics_from(given).trust == "exact"
    assert intrinsics_from(given | {"trust": "approximate"}).trust == "approximate"
    with pytest.raises(InvalidIntrinsics, match="exact or approximate") as caught:
        intrinsics_from(given | {"trust": "maybe"})
    assert caught.value.where == "trust"


def test_only_approximate_intrinsics_leave_the_focal_length_open() -> None:
    rgb = np.zeros((LENS.height, LENS.width, 3), np.uint8)
    loose: Intrinsics = replace(LENS, trust="approximate")
    exact, given, guessed = (query_of(rgb, intrinsics=lens).lens_prior for lens in (LENS, loose, None))
    assert exact is None
    assert given is not None
    assert guessed is not None
    assert 0 < given.log_focal_scale < guessed.log_focal_scale


def _seen_by_opencv(camera: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Pixels of rays (x, y) at z = 1."""
    is_fisheye = "FISHEYE" in camera.model
    coefficients = np.zeros(4 if is_fisheye else 8)
    coefficients[: len(camera.distortion)] = camera.distortion
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.column_stack([rays, np.ones(len(rays))])[:, None]
    project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    return project(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]


@pytest.mark.parametrize(
    ("model", "distortion", "max_error_px"),
    [
        ("SIMPLE_RADIAL", (-0.05,), 1.0),
        ("RADIAL", (-0.1, 0.02), 0.2),
        ("OPENCV", (-0.12, 0.03, 0.002, -0.001), 0.2),
        ("FULL_OPENCV", (-0.1, 0.02, 0.001, -0.001, 0.0, 0.02, 0.001, 0.0), 0.2),
        ("SIMPLE_RADIAL_FISHEYE", (0.02,), 0.2),
        ("OPENCV_FISHEYE", (0.02, -0.01, 0.003, 0.0), 0.2),
    ],
)
@pytest.mark.parametrize(("focal_factor", "k1"), [(1.15, 0.0), (0.88, 0.0), (1.12, 0.03), (0.9, -0.02)])
def test_corrected_intrinsics_with_a_distortion_are_those_of_the_photo(
    model: str, distortion: tuple[float, ...], max_error_px: float, focal_factor: float, k1: float
) -> None:
    """Against OpenCV: the ray that corrected intrinsics see in the undistorted image, distorted as was given."""
    given = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, model, distortion, "approximate")
    rays = np.stack(np.meshgrid(np.linspace(-0.55, 0.55, 12), np.linspace(-0.42, 0.42, 9)), -1).reshape(-1, 2)
    undistorted_rays = focal_factor * rays * (1 + k1 * (rays**2).sum(1, keepdims=True))
    reported = given.distorted(IntrinsicsCorrection(focal_factor, k1=k1))
    assert reported.fx == pytest.approx(500.0 * focal_factor)
    error = np.linalg.norm(_seen_by_opencv(reported, rays) - _seen_by_opencv(given, undistorted_rays), axis=1)
    assert error.max() < max_error_px


@pytest.mark.parametrize("focal_factor", [0.5, 1.0, 2.0])
def test_one_radial_parameter_is_right_near_the_centre_however_the_rest_folds(focal_factor: float) -> None:
    """k1 = -0.5 folds within the image: a fit over all of it would be wrong where the image is used."""
    given = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, "SIMPLE_RADIAL", (-0.5,), "approximate")
    reported = given.distorted(IntrinsicsCorrection(focal_factor, k1=0.35))
    assert reported.distortion == pytest.approx((-0.5 * focal_factor**2 + 0.35,))
