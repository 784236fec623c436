"""Either side of thresholds: inputs just below and just above them, and what the docstrings promise there."""

from __future__ import annotations

import colorsys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from fake_service import FakeService
from pydantic import ValidationError

from service import multi_scene
from service.client import Client
from service.coverage import plan_drawing
from service.geometry import look_at, moved
from service.interfaces import Features
from service.lenses.lens_estimate import LensEstimate, LensMeasurement, Viewpoint, updated
from service.pose.absolute_pose.prior_region import distance_outside, inside_prior, widened_prior
from service.pose.descent.contribution_pruning import prune
from service.pose.descent.hypotheses import poses_near_views
from service.pose.features.in_plane_rotation import Corners, rolls_to_upright
from service.pose.features.query_images import QueryImages, _away_from_edges
from service.pose.features.rendered_views import View
from service.pose.features.scene_focus import focus_of_scene, is_forward_facing
from service.pose.verification.ambiguity import explains_whole_photo, rank_answers
from service.pose.verification.appearance import GLOBAL_SIGNALS, LOCAL_COLOUR
from service.pose.verification.mirror_images import dissimilarity, may_be_mirrored
from service.results import Status
from service.types import BoxPrior, Camera, GaussianPosePrior, GaussianScene, Intrinsics, Pose, Query, SceneInfo
from service.web.settings import Settings
from viewer import colours, job_stream, scene_cache
from viewer.frusta import hit_frustum
from viewer.job_stream import JobStream

HERE = Pose(np.eye(4))
CAMERA = Intrinsics(320, 240, 250.0, 250.0, 160.0, 120.0)


def beside(degrees: float = 0.0, units: float = 0.0) -> Pose:
    return moved(HERE, np.array([0, np.radians(degrees), 0, units, 0, 0]))


def scene_of(means: np.ndarray, opacity: float | np.ndarray = 0.9) -> GaussianScene:
    count = len(means)
    return GaussianScene(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.01, np.float32),
        np.broadcast_to(np.float32(opacity), count).copy(),
        np.zeros((count, 1, 3), np.float32),
        SceneInfo("s", "s", "0" * 64, "ply"),
    )


# ------------------------------------------------------------------ settings

COUNTS = ("workers", "queue_size", "queue_bytes", "keep_jobs", "crashes", "max_upload_bytes", "max_frames")
COUNTS += ("max_uploads", "max_scene_bytes", "scene_memory_bytes", "gpu_memory_bytes")
SPANS = ("max_job_s", "stuck_s", "keep_days", "upload_s", "send_s", "max_wait_s")
MAY_BE_ZERO = ("port", "shutdown_s", "keep_bytes", "photo_grace_s", "keep_lenses")


@pytest.mark.parametrize(
    ("name", "least", "below"),
    [(name, 1, 0) for name in COUNTS] + [(name, 0.01, 0) for name in SPANS] + [(n, 0, -1) for n in MAY_BE_ZERO],
)
def test_settings_have_a_least_value(name: str, least: float, below: float) -> None:
    assert getattr(Settings(scenes=[], **{name: least}), name) == least
    with pytest.raises(ValidationError, match=name):
        Settings(scenes=[], **{name: below})


def test_as_many_jobs_run_as_there_are_replicas_unless_workers_are_named() -> None:
    for given, jobs in (({}, 3), ({"workers": 7}, 7), ({"engine": "embedded", "workers": 7}, 7)):
        assert Settings(scenes=[], **{"engine": "ray", "ray_replicas": 3} | given).jobs_at_once == jobs
    here = Settings(scenes=[], ray_replicas=1234)
    assert here.jobs_at_once == here.jobs.workers == here.workers < 1234


@pytest.mark.parametrize(("name", "most"), [("port", 65535), ("max_wait_s", 3600)])
def test_settings_have_a_largest_value(name: str, most: int) -> None:
    Settings(scenes=[], **{name: most})
    with pytest.raises(ValidationError, match=name):
        Settings(scenes=[], **{name: most + 1})


# ------------------------------------------------------------------ memory of lenses


def viewpoint(degrees: float = 0.0, units: float = 0.0, distance: float = 10.0, scene: str = "a") -> Viewpoint:
    return Viewpoint(scene, beside(degrees, units), distance)


@pytest.mark.parametrize(
    ("other", "differs"),
    [
        (viewpoint(4.9), False),
        (viewpoint(5.1), True),
        (viewpoint(0, 0.49), False),
        (viewpoint(0, 0.51), True),
        (viewpoint(0, 0.49, distance=9.0), True),  # of the smaller distance
        (viewpoint(scene="b"), True),
    ],
)
def test_another_viewpoint_is_five_degrees_or_a_twentieth_of_the_distance_away(other: Viewpoint, differs: bool) -> None:
    assert viewpoint().differs(other) is other.differs(viewpoint()) is differs


@pytest.mark.parametrize("component", [0, 1])
@pytest.mark.parametrize(("sigmas", "contradicts"), [(3.9, False), (4.1, True)])
def test_a_photo_contradicts_from_four_sigmas_on(component: int, sigmas: float, contradicts: bool) -> None:
    before = LensEstimate((0.0,) * 4, (0.01,) * 4, 5, 5, viewpoint())
    scatter = (0.007, 0.003)[component]
    value = [0.0] * 4
    value[component] = sigmas * float(np.sqrt(0.01**2 + 0.02**2 + scatter**2))
    after = updated(before, LensMeasurement(tuple(value), (0.02,) * 4, viewpoint(90)))  # type: ignore[arg-type]
    assert (after.viewpoints == 0) is contradicts
    assert (after.mean[component] == 0) is contradicts
    assert after.photos == 6


def test_certainty_ends_at_a_sixteenth_of_the_photos_scatter() -> None:
    estimate: LensEstimate | None = None
    for k in range(200):
        estimate = updated(estimate, LensMeasurement((0.0,) * 4, (1e-4,) * 4, viewpoint(10 * k)))
    assert estimate is not None
    # Of the variance: a quarter of the standard deviation.
    assert estimate.sigma == pytest.approx(np.array([0.007, 0.003, 0.005, 0.005]) / 4)


# ------------------------------------------------------------------ prior regions


def test_a_gaussian_ends_at_its_quantile_and_a_box_at_its_sides() -> None:
    # Of chi-square with 6 degrees of freedom: the share beyond 2 x is exp(-x) (1 + x + x^2 / 2).
    x = np.linspace(8, 15, 10_000)
    limit = float(np.sqrt(2 * np.interp(-0.001, -np.exp(-x) * (1 + x + x**2 / 2), x)))
    gaussian = GaussianPosePrior(HERE, np.diag([0.01] * 3 + [0.04] * 3))
    box = BoxPrior(np.full(3, -1.0), np.full(3, 1.0))
    for share, inside in ((0.999, True), (1.001, False)):
        assert inside_prior(gaussian, beside(0, share * limit * 0.2)) is inside
        assert inside_prior(box, beside(0, share)) is inside
    assert distance_outside(box, Pose(np.block([[np.eye(3), np.array([[4.0], [5.0], [0.0]])], [0, 0, 0, 1]]))) == 5
    assert inside_prior(None, beside(0, 1e6))


def test_a_prior_is_widened_by_three_degrees_and_a_twentieth_of_the_distance() -> None:
    gaussian = widened_prior(GaussianPosePrior(HERE, np.diag([1e-6] * 6)), 8.0)
    assert isinstance(gaussian, GaussianPosePrior)
    sigmas = np.sqrt(np.diag(gaussian.covariance))
    assert sigmas == pytest.approx([np.radians(3.0)] * 3 + [0.4] * 3, rel=1e-3)
    box = widened_prior(BoxPrior(np.zeros(3), np.ones(3)), 8.0)
    assert isinstance(box, BoxPrior)
    assert np.allclose([box.lower_in_world, box.upper_in_world], [[-0.4] * 3, [1.4] * 3])
    assert widened_prior(None, 8.0) is None


# ------------------------------------------------------------------ answers against one another


def test_a_pose_explains_the_whole_photo_by_both_signals() -> None:
    cases = {(0.96, 0.985): True, (0.94, 0.985): False, (0.96, 0.975): False, (0.94, 0.975): False}
    for (gradients, colour), whole in cases.items():
        assert explains_whole_photo({"gradients": gradients, "colours": colour}) is whole


def test_improbable_answers_are_not_reported() -> None:
    # Two answers whose residuals have the ratio r: the second's probability is 1 / (1 + r^10).
    for probability, count in ((0.021, 2), (0.019, 1)):
        ratio = (1 / probability - 1) ** 0.1
        assert len(rank_answers([1.0, ratio])) == count


def test_only_a_fit_beyond_doubt_excludes_a_mirror_image() -> None:
    assert may_be_mirrored({"gradients": 0.985})
    assert not may_be_mirrored({"gradients": 0.995})
    alike = dict.fromkeys([*GLOBAL_SIGNALS, LOCAL_COLOUR], 1.0)
    assert dissimilarity(alike) == 0
    assert dissimilarity(dict.fromkeys(alike, 0.9)) == pytest.approx(0.1 * len(alike))


# ------------------------------------------------------------------ which scenes are searched


@pytest.mark.parametrize(
    ("inliers", "localized", "searched"),
    [
        ((100, 51, 20), (True, False, False), [0, 1]),  # similar rooms are told apart by verification
        ((100, 50, 20), (True, False, False), [0, 1]),
        ((100, 49, 20), (True, False, False), [0]),
        ((100, 49, 20), (False, True, True), [0, 1]),
        ((20, 100, 60, 55, 52), (False,) * 5, [1, 2, 3]),  # three at most
    ],
)
def test_similar_scenes_are_searched_and_three_at_most(
    inliers: tuple[int, ...], localized: tuple[bool, ...], searched: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []

    def localize(query: Any, loaded: Any, request: Any) -> Any:
        done.append(loaded.number)
        status = Status.LOCALIZED if localized[loaded.number] else Status.NOT_LOCALIZED
        return _Estimate(SimpleNamespace(status=status, score=0.5))

    monkeypatch.setattr(multi_scene, "_inliers_by_scene", lambda *_: np.array(inliers))
    monkeypatch.setattr(multi_scene, "localize", localize)
    told: dict[str, Any] = {}
    monkeypatch.setattr(multi_scene, "replace", lambda value, **changes: told.update(changes) or value)
    monkeypatch.setattr(multi_scene, "SceneEstimate", lambda estimate, loaded: SimpleNamespace(**locals()))
    info = SimpleNamespace(info=SimpleNamespace(id="s"))
    scenes: Any = [SimpleNamespace(number=k, scene=info) for k in range(len(inliers))]
    found = multi_scene.localize_in_scenes(SimpleNamespace(), scenes)  # type: ignore[arg-type]
    assert done == searched
    ranking = told["timings"][0]
    assert 0 <= ranking.wall_s < 10  # nothing is done
    assert 0 <= ranking.cpu_s < 1
    assert localized[found.loaded.number] is any(localized[k] for k in searched)


class _Estimate:
    timings, records = (), ()

    def __init__(self, verdict: Any) -> None:
        self.verdict = verdict


# ------------------------------------------------------------------ the photo


def test_features_keep_six_pixels_from_what_is_no_photo() -> None:
    valid = np.zeros((40, 60), bool)
    valid[:, 20:] = True
    points = np.array([[x + 0.5, 20.0] for x in (24, 25, 26, 27, 59)])
    size = Intrinsics(60, 40, 50.0, 50.0, 30.0, 20.0)
    # Columns 14 to 19 away from the last invalid one, 19: from 26 on.
    assert _away_from_edges(points, valid, size, False).tolist() == [False, False, True, True, True]
    assert _away_from_edges(points, None, size, False).all()
    inside = _away_from_edges(np.array([[5.9, 20], [6.1, 20], [53.9, 20], [54.1, 20.0]]), None, size, True)
    assert inside.tolist() == [False, True, True, False]


@pytest.mark.parametrize(("spoilt", "valid"), [(0, True), (1, True), (3, False)])
def test_a_reduced_pixel_is_valid_if_all_but_a_hundredth_of_it_is(spoilt: int, valid: bool) -> None:
    mask = np.ones((320, 320), bool)
    mask[:1, :spoilt] = False  # of 16 x 16 pixels
    lens = Intrinsics(320, 320, 300.0, 300.0, 160.0, 160.0)
    query = Query(np.zeros((320, 320, 3), np.uint8), lens, "given", lens, valid_mask=mask)
    found = QueryImages(query, SimpleNamespace()).valid_mask(lens.resized(20, 20))  # type: ignore[arg-type]
    assert found is not None
    assert bool(found[0, 0]) is valid
    assert found[1:, 1:].all()


@pytest.mark.parametrize(("second", "rolls"), [(6, [2]), (7, [2, 5]), (8, [2, 5])])
def test_a_rotation_that_seven_tenths_as_many_corners_suggest_is_tried_too(second: int, rolls: list[int]) -> None:
    rng = np.random.default_rng(0)
    count = 10 + second
    descriptors = rng.integers(0, 256, (count, 32)).astype(np.uint8)
    upright = rng.uniform(0, 360, count).astype(np.float32)
    turned = upright + np.repeat(np.float32([90, 225]), [10, second])
    assert rolls_to_upright(Corners(turned, descriptors), Corners(upright, descriptors)) == rolls
    assert rolls_to_upright(Corners.pooled([]), Corners(upright, descriptors)) == [0]


# ------------------------------------------------------------------ scenes and hypotheses


@pytest.mark.parametrize(("half_angle_deg", "forward"), [(14.5, True), (15.5, False)])
def test_axes_within_fifteen_degrees_face_forward(half_angle_deg: float, forward: bool) -> None:
    assert is_forward_facing([beside(half_angle_deg), beside(-half_angle_deg)]) is forward


def test_without_cameras_the_focus_is_twice_the_radius_away_and_haze_counts_for_nothing() -> None:
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(2000, 3))
    sphere = 3.0 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True) + [1, 2, 3]
    haze = np.full((5000, 3), 50.0)
    opacity = np.r_[np.full(2000, 0.31), np.full(5000, 0.29)]
    focus = focus_of_scene(scene_of(np.concatenate([sphere, haze]), opacity), SimpleNamespace())  # type: ignore[arg-type]
    assert focus.point_in_world == pytest.approx([1, 2, 3], abs=0.2)
    assert focus.distance == pytest.approx(6.0, rel=0.03)


def test_pruning_keeps_the_fewest_with_95_percent_of_all_contribution() -> None:
    scene = scene_of(np.arange(300.0).reshape(100, 3))
    assert prune(scene, np.ones(100)).count in (95, 96)  # equality is decided by rounding
    few = np.full(100, 1e-9)
    few[[7, 70]] = 1.0
    assert np.array_equal(prune(scene, few).means, scene.means[[7, 70]])


def test_hypotheses_near_views_have_the_spread_that_is_stated() -> None:
    """A view 10 units before a single point: the way to it is a share -0.4 to 0.6, and 0.15 aside per axis."""
    pose = look_at(np.array([0.0, 0.0, -10.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    none = Features(np.zeros((1, 2), np.float32), np.zeros(1, np.float32), np.zeros((1, 2), np.float32))
    view = View(Camera(CAMERA, pose), none, np.zeros((1, 3), np.float32))
    found = poses_near_views([view], np.ones(1), 0.0, 1200, np.random.default_rng(0))
    positions = np.stack([each.position_in_world for each in found])
    assert positions[:, :2].std() == pytest.approx(1.5, rel=0.06)
    # The sum of an even distribution over 10 units and of a normal one.
    assert -positions[:, 2].mean() == pytest.approx(9.0, abs=0.3)
    assert positions[:, 2].std() == pytest.approx(np.hypot(10 / np.sqrt(12), 1.5), rel=0.06)
    upright = [look_at(each.position_in_world, np.zeros(3), np.array([0.0, 1.0, 0.0])) for each in found]
    rolls = [
        np.arctan2(*(a.world_from_camera[:3, 0] @ b.world_from_camera[:3, k] for k in (1, 0)))
        for a, b in zip(found, upright, strict=True)
    ]
    assert np.std(rolls) == pytest.approx(0.2, rel=0.07)


def test_views_with_less_than_half_of_the_best_score_are_hardly_ever_chosen() -> None:
    views = []
    for k in range(3):
        pose = look_at(np.array([100.0 * k, 0, -1]), np.array([100.0 * k, 0, 0]), np.array([0.0, 1.0, 0.0]))
        none = Features(np.zeros((1, 2), np.float32), np.zeros(1, np.float32), np.zeros((1, 2), np.float32))
        views.append(View(Camera(CAMERA, pose), none, np.array([[100.0 * k, 0, 0]], np.float32)))
    found = poses_near_views(views, np.array([1.0, 0.75, 0.49]), 0.0, 500, np.random.default_rng(0))
    chosen = np.bincount([round(each.position_in_world[0] / 100) for each in found], minlength=3)
    # Squares of the margins 0.5 and 0.25.
    assert chosen[1] / chosen[0] == pytest.approx(0.25, abs=0.08)
    assert chosen[2] == 0


# ------------------------------------------------------------------ the viewer


def test_each_colour_has_the_hue_that_its_meaning_suggests() -> None:
    """As docs/viewer.md says of the cameras: orange, grey, white; green is good and red is bad."""
    hues = {"localized": 120, "uncertain": 38, "not_localized": 0, "failed": 0}
    named = [(colours.STATUS_COLOURS[status], hue) for status, hue in hues.items()]
    named += [(colours.CURRENT_COLOUR, 33), (colours.PENDING_COLOUR, 210), (colours.ERROR_COLOUR, 0)]
    named += [(colours.INLIER_COLOUR, 120), (colours.OUTLIER_COLOUR, 0), (colours.TRAINING_COLOUR, 217)]
    for colour, hue in named:
        assert abs((_hue_and_saturation(colour)[0] - hue + 180) % 360 - 180) <= 20, (colour, hue)
        # Vivid but for training cameras, which are many.
        assert _hue_and_saturation(colour)[1] > (0.5 if colour == colours.TRAINING_COLOUR else 0.66)
    for grey in (colours.INITIAL_COLOUR, colours.UNKNOWN_COLOUR, colours.TRUTH_COLOUR):
        assert _hue_and_saturation(grey)[1] == 0
        assert 100 <= min(grey) <= max(grey) <= 255
    assert min(colours.TRUTH_COLOUR) > 230
    greys = colours.STATUS_COLOURS["cancelled"], colours.STATUS_COLOURS["interrupted"]
    assert all(_hue_and_saturation(grey)[1] == 0 for grey in greys)
    everything = [*colours.STATUS_COLOURS.values(), *(colour for colour, _ in named), *greys]
    assert all(0 <= part <= 255 for colour in everything for part in colour)
    assert set(colours.STATUS_COLOURS) >= {status.value for status in Status}


def test_the_map_in_the_viewer_has_the_levels_of_its_drawing_and_lighter_colours_of_their_hues() -> None:
    """Lighter, since the viewer's background is dark: from blue, found, to orange, rarely found."""
    assert [level[::2] for level in colours.COVERAGE_LEVELS] == [level[::2] for level in plan_drawing.LEVELS]
    ours, drawn = ([colour for _, colour, _ in levels] for levels in (colours.COVERAGE_LEVELS, plan_drawing.LEVELS))
    hues = [_hue_and_saturation(colour)[0] for colour in ours]
    assert hues == pytest.approx([_hue_and_saturation(colour)[0] for colour in drawn], abs=6)  # 3.6 was seen
    assert min(hues[:2]) > 180 > 60 > max(hues[2:])
    assert all(sum(light) > sum(dark) and max(light) <= 255 for light, dark in zip(ours, drawn, strict=True))
    grey = colours.BLIND_COLOUR
    assert len(set(grey)) == 1
    assert max(grey) < min(max(colour) for colour in ours)


def test_scores_and_residuals_go_evenly_from_one_colour_to_another() -> None:
    scale = colours.score_colours(np.linspace(0, 1, 5))
    lightness = cv2.cvtColor(scale[None], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert all(30 <= step <= 36 for step in np.diff(lightness))
    hues, saturations = zip(*(_hue_and_saturation(tuple(map(int, colour))) for colour in scale), strict=True)
    # From blue to yellow, past green.
    assert 220 < hues[0] < 240
    assert 45 < hues[-1] < 60
    assert sorted(hues, reverse=True) == list(hues)
    assert min(saturations) > 0.5
    assert saturations[-1] > 0.7
    view = SimpleNamespace(residual_px=np.sqrt([0.5 * 50.0]))
    yellow = colours.match_colours(view, "residual")[0]  # type: ignore[arg-type]
    hue, saturation = _hue_and_saturation(tuple(map(int, yellow)))
    assert abs(hue - 60) < 5
    assert saturation > 0.6


def _hue_and_saturation(colour: tuple[int, int, int]) -> tuple[float, float]:
    hue, saturation, _ = colorsys.rgb_to_hsv(*(part / 255 for part in colour))
    return 360 * hue, saturation


def test_a_click_within_six_tenths_of_a_frustums_depth_hits_it() -> None:
    pose = HERE.world_from_camera[None]
    straight = np.array([0.0, 0.0, 1.0])
    for aside, hit in ((1.19, 0), (1.21, None)):
        assert hit_frustum(np.array([aside, 0, -10.0]), straight, pose, 2.0) == hit
    assert hit_frustum(np.array([0.0, 0, 10.0]), straight, pose, 2.0) is None  # behind the eye
    # The nearer one of two, and its middle counts, not its apex.
    two = np.stack([beside(0, 0.2).world_from_camera, HERE.world_from_camera])
    two[0, 2, 3] = 5.0
    assert hit_frustum(np.array([0.0, 0, -10.0]), straight, two, 2.0) == 1
    across = np.array([1.0, 0.0, 0.0])
    for height, hit in ((-0.05, None), (0.05, 0), (2.35, 0), (2.45, None)):
        assert hit_frustum(np.array([-10.0, 0, height]), across, pose, 2.0) == hit


def test_the_last_64_images_and_two_scenes_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeService()
    fake.job("d", 70)
    client = Client("http://fake", transport=fake.transport)
    stream = JobStream(client, "d")
    asked = []
    monkeypatch.setattr(client, "step_render", lambda id, index, camera: asked.append(index) or b"")
    monkeypatch.setattr(job_stream, "decode", lambda data: np.zeros((1, 1, 3), np.uint8))
    for index in [*range(64), 0, 64, 0, 1]:  # 0 was used last, 1 had to go
        stream.render(index, matched=False)
    assert asked == [*range(65), 1]
    cache, loaded = scene_cache.SceneCache(client), []
    ball = client.scene("ball")
    monkeypatch.setattr(client, "scene", lambda name: loaded.append(name) or ball)
    for name in ("a", "b", "a", "c", "a", "b"):
        cache.get(name)
    assert loaded == ["a", "b", "c", "b"]
