"""The gate's rules at their thresholds: planted signals and uncertainties just at, below and above what is promised."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.accuracy import Accuracy
from service.geometry import look_at, moved
from service.interfaces import Features, Frame
from service.pose.features.rendered_views import View
from service.pose.matching.correspondences import Correspondences
from service.pose.refinement.lens_test import LensFit, moves_pose
from service.pose.refinement.uncertainty import PoseIfCropped, PoseUncertainty
from service.pose.verification import advice, gate, photo_quality
from service.pose.verification.advice import ADVICE
from service.pose.verification.captured_volume import captured_share, is_outside
from service.pose.verification.gate import VERIFICATION, doubted, photometric_suffices, verdict_of
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.pose.verification.photo_quality import photo_faults
from service.pose.verification.precision import AskedBounds, probability_within
from service.pose.verification.rig_gate import rig_verdict
from service.pose.verification.signals import geometry_signals, match_signals, typical_depth
from service.results import Reason, Status, Verdict
from service.types import NO_CORRECTION, Camera, Intrinsics, Pose, Query

ASKED = AskedBounds.of(Accuracy(), 10.0)
"""5 degrees, and 2 % of a distance of 10: 0.2 units."""
LOOSER = AskedBounds(10.0, 0.4, 10.0)
"""Twice the default bounds."""


@dataclass(frozen=True)
class PlantedModel:
    """A model that says how probable the place is, and which signals are below their floors."""

    place: float = 0.95
    below: tuple[str, ...] = ()
    scales = SHIPPED_MODEL.scales

    def probability(self, signals: Any) -> float:
        return self.place

    def below_floor(self, signals: Any, light_may_differ: bool = False) -> list[str]:
        return [] if light_may_differ else list(self.below)


def signals(level: float = 0.97, matches: float | None = None, **changed: float) -> dict[str, float]:
    """Return signals of this scaled level, 0..1; those of matches of another, if one is given."""
    levels = dict.fromkeys(SHIPPED_MODEL.scales, level)
    if matches is not None:
        levels |= dict.fromkeys(("inliers", "inlier_share", "inlier_spread"), matches)
    scaled = {name: SHIPPED_MODEL.scales[name].value_at(value) for name, value in levels.items()}
    return scaled | {"coverage": 1.0, "sigma_share": 0.001, "drift_px": 0.1} | changed


def covariance(sigma_rad: float = 1e-4, sigma_units: float = 1e-3) -> np.ndarray:
    return np.diag([sigma_rad**2] * 3 + [sigma_units**2] * 3)


CERTAIN = PoseUncertainty(np.zeros(6), covariance())


def verdict(
    found: dict[str, float] | None = None, uncertainty: PoseUncertainty | None = CERTAIN, asked: AskedBounds = ASKED,
    place: float = 0.95, below: tuple[str, ...] = (), **options: Any,
) -> Verdict:  # fmt: skip
    config = replace(VERIFICATION, model=PlantedModel(place, below))
    return verdict_of(found or signals(), uncertainty, asked, config=config, **options)


# ------------------------------------------------------------------ the place


@pytest.mark.parametrize(
    ("place", "uncertainty", "status"),
    [
        (0.8, CERTAIN, "localized"),
        (0.7999, CERTAIN, "uncertain"),
        (0.1, CERTAIN, "uncertain"),
        (0.0999, CERTAIN, "not_localized"),
        (0.9, None, "not_localized"),  # nobody can check a pose that the pixels don't determine
    ],
)
def test_the_status_is_by_the_probability_of_the_place(place, uncertainty, status) -> None:
    found = verdict(place=place, uncertainty=uncertainty)
    assert (found.status, found.right_place) == (Status(status), place)
    assert photometric_suffices(signals(), replace(VERIFICATION, model=PlantedModel(place))) is (place >= 0.8)


def test_a_signal_below_its_floor_makes_the_place_a_matter_of_chance() -> None:
    found = verdict(below=("colours",))
    assert (found.status, found.reason, found.right_place) == (Status.UNCERTAIN, Reason.RENDER_MISMATCH, 0.5)
    assert verdict(below=("inliers",)).reason is Reason.FEW_INLIERS
    assert verdict(below=("colours",), light_may_differ=True).status is Status.LOCALIZED
    assert verdict(below=("colours",), few_features=True).reason is Reason.FEW_FEATURES
    # What is less probable than that stays so.
    assert verdict(place=0.3, below=("colours",)).right_place == 0.3
    assert not photometric_suffices(signals(), replace(VERIFICATION, model=PlantedModel(below=("colours",))))


@pytest.mark.parametrize(
    ("pixels", "matches", "reason"),
    [
        (0.34, 0.34, "no_matching_view"),
        (0.36, 0.34, "few_inliers"),
        (0.34, 0.36, "render_mismatch"),
        (0.36, 0.37, "render_mismatch"),
    ],
)
def test_nothing_was_recognised_where_both_kinds_of_signals_are_below_seven_twentieths(pixels, matches, reason) -> None:
    drift_px = SHIPPED_MODEL.scales["drift_px"].value_at(pixels)
    assert verdict(signals(pixels, matches, drift_px=drift_px), place=0.2).reason is Reason(reason)


@pytest.mark.parametrize(("coverage", "little"), [(0.04, False), (0.0399, True)])
def test_a_photo_that_shows_less_than_a_25th_of_scene_is_in_doubt(coverage: float, little: bool) -> None:
    found = verdict(signals(coverage=coverage))
    assert (found.reason is Reason.LOW_COVERAGE) is little
    assert found.right_place == (0.5 if little else 0.95)
    # Few inliers are then a consequence; few features are not.
    refused = verdict(signals(coverage=coverage), place=0.2, below=("inliers",))
    assert refused.reason is (Reason.LOW_COVERAGE if little else Reason.FEW_INLIERS)
    assert verdict(signals(coverage=coverage), place=0.2, few_features=True).reason is Reason.FEW_FEATURES


def test_a_picture_of_something_else_has_less_than_three_tenths_of_the_global_signals() -> None:
    for level, unlike in ((0.301, False), (0.299, True)):
        assert gate._is_unlike(signals(level, matches=1.0, local_colour_correlation=1.0), VERIFICATION) is unlike


def test_a_doubt_takes_half_of_the_part_that_it_is_about() -> None:
    found = verdict()
    place, lens = doubted(found, Reason.AMBIGUOUS), doubted(found, Reason.FOCAL_UNCERTAIN)
    assert (place.right_place, place.precise) == (0.5, found.precise)
    assert (lens.right_place, lens.precise) == (found.right_place, 0.5)
    for each in (place, lens):
        assert each.status is Status.UNCERTAIN
        assert each.score == each.right_place * each.precise
    # Never more than before; an unknown precision counts as certain.
    low = replace(found, right_place=0.2, score=0.2, precise=None)
    assert doubted(low, Reason.AMBIGUOUS).score == pytest.approx(0.2)
    assert gate.downgraded(replace(found, status=Status.NOT_LOCALIZED), Reason.AMBIGUOUS).reason is found.reason


# ------------------------------------------------------------------ how exact it is


def sigma_of_probability(probability: float) -> float:
    """Return the standard deviation of the position, in each direction, that is within the bound so probably."""
    low, high = 1e-3, 1.0
    for _ in range(60):
        middle = np.sqrt(low * high)
        if probability_within(covariance(1e-6, middle), ASKED.deg, ASKED.units) > probability:
            low = middle
        else:
            high = middle
    return float(low)


@pytest.mark.parametrize(("probability", "precise"), [(0.911, True), (0.909, False)])
def test_a_pose_is_precise_that_is_within_the_bounds_in_91_of_100_cases(probability: float, precise: bool) -> None:
    sigma = sigma_of_probability(probability)
    # As the docstring says: 0.9 to 0.94 % of the distance to what is seen, in all directions together.
    assert 0.085 < np.sqrt(3) * sigma < 0.095
    uncertain = PoseUncertainty(np.zeros(6), covariance(1e-6, sigma))
    found = verdict(uncertainty=uncertain)
    assert (found.reason is Reason.VERIFIED) is precise
    assert found.reason in (Reason.VERIFIED, Reason.POSITION_UNCERTAIN)
    assert found.precise == pytest.approx(probability, abs=1e-3)
    # With intrinsics that are approximate these are what is missing, if they would make it certain.
    for given, reason in ((covariance(), Reason.FOCAL_UNCERTAIN), (covariance(1e-6, 1.0), Reason.POSITION_UNCERTAIN)):
        approximate = replace(uncertain, given_lens=given)
        assert verdict(uncertainty=approximate).reason is (Reason.VERIFIED if precise else reason)


@pytest.mark.parametrize(
    ("step", "asked", "certain"),
    [(0.008, ASKED, True), (-0.0081, ASKED, False), (0.016, LOOSER, True), (0.0161, LOOSER, False)],
)
def test_an_approximate_focal_length_is_settled_to_eight_thousandths(step, asked, certain) -> None:
    found = verdict(uncertainty=replace(CERTAIN, focal_step=step), asked=asked)
    assert found.reason is (Reason.VERIFIED if certain else Reason.FOCAL_UNCERTAIN)
    assert (found.precise <= 0.5) is not certain


@pytest.mark.parametrize(("drift_px", "settled"), [(0.3, True), (0.301, False)])
def test_with_approximate_intrinsics_a_step_moves_the_image_by_three_tenths_of_a_pixel(drift_px, settled) -> None:
    approximate = replace(CERTAIN, given_lens=covariance())
    found = verdict(signals(drift_px=drift_px), approximate)
    assert found.reason is (Reason.VERIFIED if settled else Reason.FOCAL_UNCERTAIN)
    assert verdict(signals(drift_px=drift_px)).reason is Reason.VERIFIED


def test_intrinsics_that_are_contradicted_are_told() -> None:
    fit = LensFit(replace(NO_CORRECTION, focal_factor=1.1), np.zeros(6), 0.9, True)
    found = verdict(uncertainty=replace(CERTAIN, lens_fit=fit))
    assert (found.reason, found.precise) == (Reason.INTRINSICS_CONTRADICTED, 0.5)
    assert found.fitting_correction == fit.correction
    other = verdict(uncertainty=replace(CERTAIN, lens_fit=replace(fit, contradicts=False)))
    assert (other.reason, other.fitting_correction) == (Reason.VERIFIED, None)


def cropped(sigma_deg: float = 0.1, sigma: float = 1e-3, step_deg: float = 0.0, chance: float = 0.0) -> PoseUncertainty:
    each = covariance(np.radians(sigma_deg) / np.sqrt(3), sigma / np.sqrt(3))
    step = np.array([np.radians(step_deg), 0, 0, 0, 0, 0])
    return replace(CERTAIN, if_cropped=PoseIfCropped(each, step, chance), given_lens=covariance())


@pytest.mark.parametrize(
    ("uncertainty", "asked", "certain"),
    [
        (cropped(sigma_deg=1.99), ASKED, True),
        (cropped(sigma_deg=2.01), ASKED, False),
        (cropped(sigma_deg=3.99), LOOSER, True),
        (cropped(sigma_deg=4.01), LOOSER, False),
        # 1.25 % of a distance of 10.
        (cropped(sigma=0.124), ASKED, True),
        (cropped(sigma=0.126), ASKED, False),
        (cropped(sigma=0.249), LOOSER, True),
        (cropped(sigma=0.251), LOOSER, False),
        # A step beyond chance is one of 6.6, squared; it counts if it moves the pose: by more than 1.25 degrees.
        (cropped(step_deg=1.24, chance=9.0), ASKED, True),
        (cropped(step_deg=1.26, chance=6.6), ASKED, True),
        (cropped(step_deg=1.26, chance=6.61), ASKED, False),
        (cropped(step_deg=2.49, chance=9.0), LOOSER, True),
        (cropped(step_deg=2.51, chance=9.0), LOOSER, False),
    ],
)
def test_a_photo_that_may_be_cropped_must_be_certain_with_any_principal_point(uncertainty, asked, certain) -> None:
    found = verdict(uncertainty=uncertainty, asked=asked)
    assert found.reason is (Reason.VERIFIED if certain else Reason.FOCAL_UNCERTAIN)


def test_what_another_step_would_change_is_part_of_the_covariance() -> None:
    step = np.array([0.001, 0, 0, 0, 0.02, 0])
    uncertain = PoseUncertainty(step, covariance(), given_lens=covariance(1e-5, 1e-5))
    found = verdict(uncertainty=uncertain)
    assert found.covariance == pytest.approx(covariance() + np.outer(step, step))
    assert found.covariance_given_lens == pytest.approx(covariance(1e-5, 1e-5) + np.outer(step, step))
    assert found.correction_sigma == (0.0, 0.0, 0.0, 0.0)
    # Of approximate intrinsics the covariance has four more rows.
    approximate = replace(uncertain, covariance=np.diag([1e-8] * 6 + [0.01, 0.04, 0.09, 0.16]))
    assert verdict(uncertainty=approximate).correction_sigma == pytest.approx((0.1, 0.2, 0.3, 0.4))
    # Of exact ones that the photo can't confirm, the covariance is told that has them a little off.
    untested = verdict(uncertainty=PoseUncertainty(np.zeros(6), covariance(), untested_lens=covariance(0.01, 0.1)))
    assert untested.covariance == pytest.approx(covariance(0.01, 0.1))
    assert (untested.intrinsics_untested, found.intrinsics_untested) == (True, False)


def test_a_focal_length_in_doubt_has_the_wider_covariance_of_a_cropped_photo() -> None:
    step = np.array([0, 0, 0, 0.3, 0, 0])
    for wide, told in ((0.5, True), (1e-4, False)):
        doubtful = replace(cropped(), focal_step=0.1)
        doubtful = replace(doubtful, if_cropped=PoseIfCropped(covariance(1e-4, wide), step, 0.0))
        expected = covariance(1e-4, wide) + np.outer(step, step) if told else covariance()
        assert verdict(uncertainty=doubtful).covariance == pytest.approx(expected)


@pytest.mark.parametrize(
    ("loss", "ratio", "deg", "units", "undecided"),
    [
        (0.03, 1.0, 0.0, 0.0, False),
        (0.031, 1.0, 0.0, 0.0, True),  # where the model is poor, only matches tell
        (0.0, 0.98, 1.26, 0.0, True),
        (0.0, 0.98, 1.24, 0.0, False),
        (0.0, 0.98, 0.0, 0.0251, True),  # a quarter of a hundredth of a distance of 10
        (0.0, 0.98, 0.0, 0.0249, False),
        (0.0, 0.981, 1.26, 0.0, False),
    ],
)
def test_matches_decide_about_exact_intrinsics_where_the_pixels_do_not(loss, ratio, deg, units, undecided) -> None:
    fit = LensFit(NO_CORRECTION, np.array([0, np.radians(deg), 0, 0, 0, units]), ratio, False)
    uncertainty = replace(CERTAIN, loss=loss, lens_fit=fit)
    assert gate._lens_is_undecided(uncertainty, 10.0, VERIFICATION) is undecided
    assert not gate._lens_is_undecided(replace(CERTAIN), 10.0, VERIFICATION)
    decided = replace(uncertainty, lens_fit=replace(fit, contradicts=True), loss=0.0)
    assert not gate._lens_is_undecided(decided, 10.0, VERIFICATION)


def test_a_twist_moves_the_pose_by_its_angle_or_its_share_of_the_depth() -> None:
    turn, way = np.array([0.6, 0.8, 0, 0, 0, 0]), np.array([0, 0, 0, 3.0, 0, 4.0])
    assert moves_pose(turn, 1.0, np.degrees(0.999), 1.0)
    assert not moves_pose(turn, 1.0, np.degrees(1.001), 1.0)
    assert moves_pose(way, 10.0, 90.0, 0.49)
    assert not moves_pose(way, 10.0, 90.0, 0.5)


# ------------------------------------------------------------------ signals

LENS = Intrinsics(120, 90, 100.0, 100.0, 60.0, 45.0)
HERE = Pose(np.eye(4))


def frame(alpha: np.ndarray | float = 1.0, depth: np.ndarray | float = 4.0) -> Frame:
    alpha, depth = (np.broadcast_to(np.float32(value), (90, 120)).copy() for value in (alpha, depth))
    return Frame(np.zeros((90, 120, 3), np.float32), alpha, depth, depth)


def test_the_typical_depth_is_the_median_of_what_is_seen() -> None:
    depth = np.zeros((90, 120), np.float32)
    depth[:, :60], depth[:, 60:80] = 3.0, 7.0
    assert typical_depth(frame(depth=depth)) == 3.0
    assert typical_depth(frame(depth=0.0)) == 1.0


def test_drift_is_in_pixels_and_counts_only_where_the_position_is_determined() -> None:
    step = np.array([0.003, 0.004, 0, 0, 0.06, 0.08])
    found = geometry_signals(frame(), LENS, PoseUncertainty(step, covariance(1e-4, 0.1)))
    # 0.005 rad, and 0.1 units at a depth of 4, times the focal length.
    assert found["drift_px"] == pytest.approx(100 * (0.005 + 0.1 / 4))
    assert found["sigma_share"] == pytest.approx(0.1 * np.sqrt(3) / 4)
    for share, drift in ((0.99, 3.0), (1.01, 1000.0)):
        spread = covariance(1e-4, share * 4 / np.sqrt(3))
        assert geometry_signals(frame(), LENS, PoseUncertainty(step, spread))["drift_px"] == pytest.approx(drift)
    nothing = geometry_signals(frame(), LENS, None)
    assert (nothing["drift_px"], nothing["sigma_share"]) == (1000.0, 1000.0)


@pytest.mark.parametrize(("alpha", "coverage"), [(0.51, 1.0), (0.5, 0.0)])
def test_what_is_more_than_half_opaque_is_covered(alpha: float, coverage: float) -> None:
    assert geometry_signals(frame(alpha), LENS, None)["coverage"] == coverage


def test_inliers_are_counted_at_the_renders_size_and_by_cells_that_show_something() -> None:
    photo = LENS.resized(240, 180)
    query = Query(np.zeros((180, 240, 3), np.uint8), photo, "given", photo)
    # On the axis at depth 2, at the photo's centre (120, 90); observed to the right of it.
    points = np.tile(np.float32([0, 0, 2]), (4, 1))
    off = np.float32([0.0, 7.8, 8.2, 50.0])  # half as many pixels of the render: less than 4 is an inlier
    seen = np.stack([120 + off, np.full(4, 90, np.float32)], 1)
    alpha = np.zeros((90, 120), np.float32)
    alpha[:, 60:] = 1.0
    found = match_signals(Correspondences(seen, seen, points), alpha, query, LENS, HERE)
    assert (found["inliers"], found["inlier_share"]) == (2.0, 0.5)
    # Of 6 by 6 cells the right half shows something; both inliers are in one of these.
    assert found["inlier_spread"] == pytest.approx(1 / 18)
    none = Correspondences(*(np.zeros((0, size), np.float32) for size in (2, 2, 3)))
    assert set(match_signals(none, alpha, query, LENS, HERE).values()) == {0.0}


# ------------------------------------------------------------------ captured or not


def captured_from(view: Pose, zoom: float = 1.0) -> float | None:
    """Return the captured share of a point at depth 4, through a lens `zoom` times as long as the view's."""
    lens = Intrinsics(5, 5, 2.5 * zoom, 2.5 * zoom, 2.5, 2.5)
    image = np.full((5, 5), np.float32(1.0))
    depth = np.full((5, 5), np.float32(4.0))
    wide = Camera(Intrinsics(400, 400, 200.0, 200.0, 200.0, 200.0), view)
    return captured_share(Frame(np.zeros((5, 5, 3), np.float32), image, depth, depth), Camera(lens, HERE), [wide])


def towards(degrees: float, distance: float) -> Pose:
    """A pose that sees the point (0, 0, 4) from this far, turned by an angle about it."""
    point, angle = np.array([0.0, 0.0, 4.0]), np.radians(degrees)
    position = point - distance * np.array([np.sin(angle), 0.0, np.cos(angle)])
    return look_at(position, point, np.array([0.0, -1.0, 0.0]))


@pytest.mark.parametrize(
    ("view", "share"),
    [
        (towards(59, 4), 1.0),
        (towards(61, 4), 0.0),
        # Through like lenses the pose may be eight times nearer than a view, and three times farther.
        (towards(0, 31.9), 1.0),
        (towards(0, 32.1), 0.0),
        (towards(0, 1.34), 1.0),
        (towards(0, 1.33), 0.0),
        (moved(towards(0, 4), np.array([0, np.pi, 0, 0, 0, 0])), 0.0),  # looks away
    ],
)
def test_a_point_is_captured_by_a_view_that_is_alike(view: Pose, share: float) -> None:
    assert captured_from(view) == share


@pytest.mark.parametrize(
    ("zoom", "distance", "share"), [(3.9, 8.0, 1.0), (4.1, 8.0, 0.0), (1 / 2.9, 4.0, 1.0), (1 / 3.1, 4.0, 0.0)]
)
def test_what_a_pixel_covers_counts_not_how_far_away_it_is_seen_from(
    zoom: float, distance: float, share: float
) -> None:
    assert captured_from(towards(0, distance), zoom) == share


def test_a_pose_is_outside_if_less_than_half_of_what_it_sees_was_captured() -> None:
    lens = Intrinsics(128, 128, 100.0, 100.0, 64.0, 64.0)
    view_camera = Camera(Intrinsics(400, 400, 100.0, 100.0, 200.0, 200.0), towards(0, 4))

    class Rendered:
        def __init__(self, near: float) -> None:
            # Everything at depth 4, but a share of the columns so near that no view sees it alike.
            self.depth = np.full((128, 128), np.float32(4.0))
            self.depth[:, : round(128 * near)] = 0.1

        def render(self, cameras):
            rgb = np.zeros((128, 128, 3), np.float32)
            return [Frame(rgb, np.ones((128, 128), np.float32), self.depth, self.depth)]

    moved_view = SimpleNamespace(camera=Camera(view_camera.intrinsics, towards(50, 4)), points_in_world=np.ones((1, 3)))
    for near, outside in ((0.4, False), (0.7, True)):
        assert is_outside(lens, HERE, Rendered(near), [moved_view]) is outside  # type: ignore[arg-type,list-item]
    # Beside a view nothing is rendered: nearer than half its distance from its points, turned by less than 45 degrees.
    for away, turned, beside in ((1.9, 44, True), (2.1, 44, False), (1.9, 46, False)):
        pose = moved(HERE, np.array([0, np.radians(turned), 0, 0, 0, 0]))
        pose = Pose(np.block([[pose.world_from_camera[:3, :3], np.array([[away], [0], [0]])], [0, 0, 0, 1]]))
        nothing = Features(*(np.zeros(shape, np.float32) for shape in ((3, 2), (3,), (3, 64))))
        view = View(Camera(lens, HERE), nothing, np.array([[0, 0, 4.0]] * 3, np.float32))
        assert is_outside(lens, pose, Rendered(1.0), [view]) is not beside  # type: ignore[arg-type]


# ------------------------------------------------------------------ what is said about a photo


def grey_photo(value: int) -> np.ndarray:
    return np.full((48, 64, 3), value, np.uint8)


def test_a_photo_is_dark_whose_brighter_pixels_are_below_a_quarter() -> None:
    black = np.zeros((48, 64, 3), np.float32)
    assert any("dark" in said for said in photo_faults(grey_photo(63), black))
    assert not any("dark" in said for said in photo_faults(grey_photo(64), black))
    # A tenth of the pixels may be bright.
    lit = grey_photo(30)
    for columns, dark in ((6, True), (7, False)):
        lit[:, :columns] = 200
        assert any("dark" in said for said in photo_faults(lit, black)) is dark


def test_a_photo_is_overexposed_of_which_35_hundredths_more_than_of_the_render_are_white() -> None:
    rendered = np.zeros((48, 64, 3), np.float32)
    rendered[:, :16] = 1.0
    photo = grey_photo(100)
    for columns, value, overexposed in ((38, 255, False), (39, 255, True), (39, 250, True), (39, 249, False)):
        photo[:], photo[:, :columns] = 100, value
        assert any("overexposed" in said for said in photo_faults(photo, rendered)) is overexposed


def test_a_photo_is_blurred_from_an_effect_of_65_hundredths_on(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, black = [], np.zeros((4, 4, 3), np.float32)
    for effect, blurred in ((0.65, False), (0.651, True)):

        def planted(grey: np.ndarray, window_px: int, effect: float = effect) -> float:
            sizes.append((grey.shape, window_px))
            return effect

        monkeypatch.setattr(photo_quality, "blur_effect", planted)
        assert any("blurred" in said for said in photo_faults(grey_photo(100), black)) is blurred
    photo_faults(np.full((960, 1280, 3), 100, np.uint8), black)
    assert sizes == [((48, 64), 9)] * 2 + [((480, 640), 9)]


def seen(solid: np.ndarray | None = None, points: np.ndarray | None = None, distance: float = 10.0) -> Any:
    rng = np.random.default_rng(0)
    inliers = rng.uniform(0.0, 1.0, (40, 2)) if points is None else points
    in_camera = rng.uniform(-3, 3, (len(inliers), 3)) + np.array([0, 0, 10])
    return advice._Seen(np.ones((10, 100), bool) if solid is None else solid, inliers, in_camera, 100, distance)


def columns(count: int, at_left: bool = True) -> np.ndarray:
    solid = np.zeros((10, 100), bool)
    solid[:, :count] = True
    return solid if at_left else solid[:, ::-1]


@pytest.mark.parametrize(
    ("solid", "said"),
    [
        # 85 hundredths of what shows the scene, or more, in one half of a photo of which less than 3/4 show it.
        (columns(58), "left half of the photo: turn left"),
        (columns(59), ""),
        (columns(58, at_left=False), "right half of the photo: turn right"),
        (columns(25) | columns(0), "left"),
        (np.roll(columns(24), 38, 1), "only 24 % of the photo: step nearer"),
        (np.roll(columns(25), 38, 1), ""),
    ],
)
def test_one_is_told_to_turn_to_the_only_half_or_to_step_nearer(solid: np.ndarray, said: str) -> None:
    (found,) = advice._about_view(seen(solid), ADVICE) or [""]
    assert said in found
    assert bool(said) is bool(found)


@pytest.mark.parametrize(("above", "side"), [(85, "up"), (84, ""), (15, "down"), (16, "")])
def test_the_only_side_has_85_of_100_points(above: int, side: str) -> None:
    points = np.full((100, 2), 0.25)
    points[::2, 0] = 0.75
    points[above:, 1] = 0.75
    assert advice._only_side(points, ADVICE) == side
    assert advice._only_side(points[:0], ADVICE) == ""


def test_the_direction_of_most_uncertainty_has_seven_tenths_of_the_variance() -> None:
    for share, named in ((0.71, True), (0.69, False)):
        for axis, word in enumerate(("sideways", "up and down", "along the viewing direction")):
            variances = np.full(3, (1 - share) / 2)
            variances[axis] = share
            said = advice._about_direction(np.diag(variances), ADVICE)
            assert [word in each for each in said] == [True] * named


def test_flatness_is_the_spread_about_the_plane_by_the_distance() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-5, 5, (4000, 2)), rng.normal(0, 0.3, (4000, 1))], 1) + np.array([0, 0, 10])
    flat = replace(seen(points=np.zeros((4000, 2))), points_in_camera=points)
    # The median of the absolute deviations is 1 / 1.4826 standard deviations.
    assert advice._flatness(flat) == pytest.approx(0.03, rel=0.05)


@pytest.mark.parametrize(
    ("distance", "known", "expected"),
    [
        (24.0, 0.049, ["exact intrinsics", "step back"]),
        (26.0, 0.051, []),
        (26.0, 0.049, ["exact intrinsics"]),
    ],
)
def test_one_steps_back_from_what_fills_the_photo_and_is_near(distance: float, known: float, expected: list) -> None:
    each = replace(verdict(), covariance=covariance(1e-4, 0.1), covariance_given_lens=covariance(1e-4, known))
    found = advice._about_position(seen(distance=distance), each, 100.0, ADVICE)
    assert [word for word in ("exact intrinsics", "step back") if word in " ".join(found)] == expected
    # 95 hundredths of the photo must be filled.
    partly = replace(seen(distance=24.0), solid=columns(95))
    assert "step back" not in " ".join(advice._about_position(partly, each, 100.0, ADVICE))
    assert advice._about_position(seen(distance=24.0), replace(each, covariance=None), 100.0, ADVICE) == []


# ------------------------------------------------------------------ the photos of a rig


def rig_photo(inliers: int = 100, share: float = 0.5, colour: float = 0.99) -> Verdict:
    told = signals(inliers=float(inliers), inlier_share=share, local_colour_correlation=colour)
    return replace(verdict(), inliers=inliers, signals=told)


def of_rig(
    *photos: Verdict, place: float = 0.3, rival: float = 0.0, spread: np.ndarray | None = None, **changed: Any
) -> Verdict:
    gate_config = replace(VERIFICATION, model=PlantedModel(place))
    spread = covariance() if spread is None else spread
    return rig_verdict(photos, changed.get("given", spread), ASKED, rival, gate=gate_config)


@pytest.mark.parametrize(
    ("second", "reason"),
    [
        (rig_photo(), "verified"),
        # A photo agrees with 25 matches, a fifth of all, and colours of 0.97; else it can't tell...
        (rig_photo(25), "verified"),
        (rig_photo(24), "few_inliers"),
        (rig_photo(share=0.2), "verified"),
        (rig_photo(share=0.199), "few_inliers"),
        (rig_photo(colour=0.97), "verified"),
        # ...or contradicts, if its matches agree. Two must agree in any case.
        (rig_photo(colour=0.969), "few_inliers"),
    ],
)
def test_two_photos_of_a_rig_must_agree(second: Verdict, reason: str) -> None:
    assert of_rig(rig_photo(), second).reason is Reason(reason)


def test_a_rig_needs_eighty_matches_in_all_and_more_photos_that_agree_than_contradict() -> None:
    assert of_rig(rig_photo(40), rig_photo(40)).reason is Reason.VERIFIED
    few = of_rig(rig_photo(40), rig_photo(39))
    assert (few.reason, few.status, few.right_place) == (Reason.FEW_INLIERS, Status.UNCERTAIN, 0.5)
    assert of_rig(rig_photo(0), rig_photo(0)).reason is Reason.NO_MATCHING_VIEW
    wrong = rig_photo(colour=0.5)
    assert of_rig(rig_photo(), rig_photo(), wrong).reason is Reason.VERIFIED
    even = of_rig(rig_photo(), rig_photo(), wrong, wrong)
    assert (even.reason, even.status, even.right_place) == (Reason.RENDER_MISMATCH, Status.UNCERTAIN, 0.5)
    # What is hidden doesn't contradict.
    assert (
        of_rig(rig_photo(), rig_photo(), rig_photo(3, colour=0.1), rig_photo(2, colour=0.1)).reason is Reason.VERIFIED
    )
    # Where none agrees nothing is found.
    assert of_rig(wrong, wrong).status is Status.NOT_LOCALIZED


def test_a_rig_is_in_the_right_place_as_if_each_photo_that_agrees_was_evidence_by_itself() -> None:
    # By the model 0.3, at least 0.6: both wrong in 0.16 of all cases; a third that can't tell adds nothing.
    assert of_rig(rig_photo(), rig_photo(), rig_photo(3)).right_place == pytest.approx(1 - 0.4**2)
    found = of_rig(rig_photo(), rig_photo(), rig_photo(), place=0.9)
    assert found.right_place == pytest.approx(1 - 0.1**3)
    assert (found.inliers, found.status) == (300, Status.LOCALIZED)
    assert found.score == pytest.approx(found.right_place * found.precise)
    assert found.signals == {"agreeing": 3.0, "contradicting": 0.0, "rival_share": 0.0}


def test_another_pose_with_half_of_the_matches_makes_a_rig_ambiguous_and_a_wide_covariance_uncertain() -> None:
    assert of_rig(rig_photo(), rig_photo(), rival=0.5).reason is Reason.VERIFIED
    rival = of_rig(rig_photo(), rig_photo(), rival=0.501)
    assert (rival.reason, rival.status, rival.right_place) == (Reason.AMBIGUOUS, Status.UNCERTAIN, 0.5)
    for probability, reason in ((0.911, Reason.VERIFIED), (0.909, Reason.POSITION_UNCERTAIN)):
        spread = covariance(1e-6, sigma_of_probability(probability))
        assert of_rig(rig_photo(), rig_photo(), spread=spread).reason is reason
    unknown = of_rig(rig_photo(), rig_photo(), given=None)
    assert (unknown.status, unknown.precise, unknown.score) == (Status.NOT_LOCALIZED, 0.0, 0.0)
