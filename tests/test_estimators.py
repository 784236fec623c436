"""The contract of every estimator, in a small room with the real renderer, and what the default one promises."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_room import FOCAL, HEIGHT, WIDTH, pose_at, write_room

from service.errors import InvalidOptions, InvalidPrior, UnknownName
from service.estimators import ESTIMATORS
from service.estimators.search_config import SEARCH
from service.geometry import moved, pose_distance
from service.interfaces import RenderTally, Tools
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.multi_scene import localize_in_scenes
from service.pose.descent.gradient_descent import loss_and_gradient
from service.pose.descent.losses import LOSSES, loss_against
from service.pose.features.rendered_views import to_uint8
from service.pose.retrieval.stored_index import prepared_index
from service.pose.retrieval.view_placement import PlacementConfig
from service.pose.retrieval.viewpoints import ViewpointConfig
from service.render.render_counter import Counted
from service.results import Candidates, IterationRecord, MatchVectors, Reason, Status
from service.scene_manager.warm_up import overview, warm_up
from service.types import Camera, Intrinsics, Pose, Query

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
LENS_UPRIGHT = Intrinsics(HEIGHT, WIDTH, FOCAL, FOCAL, HEIGHT / 2, WIDTH / 2)
DEFAULT = "view_index"
QUICK: dict[str, dict] = {
    "mc_do": {"hypotheses": 16, "rounds": 1, "iterations": 4, "refinement_steps": 20},
    "inerf": {"steps": 100, "long_side_px": 160, "rate": 0.02},
    "inerf_dagger": {"steps": 100, "long_side_px": 160, "rate": 0.02},
    "pnerf": {
        "hypotheses": 2,
        "steps": 120,
        "resample_every": 80,
        "long_side_px": 160,
        "turn_rate": 0.01,
        "shift_rate": 0.05,
    },
    "icomma": {"steps": 100, "rematch_every": 10, "long_side_px": 224, "rate": 0.02},
}
"""Where the defaults are for far starts: options with which a near one is enough."""
BRIEF: dict[str, dict] = {
    "mc_do": {"hypotheses": 8, "iterations": 2, "refinement_steps": 6},
    "pnerf": {"steps": 12, "resample_every": 8},
    "inerf": {"steps": 12},
    "inerf_dagger": {"steps": 12},
    "icomma": {"steps": 12},
}
"""As few steps as show each kind of them, where the pose that is found doesn't matter."""
PHOTOMETRIC = {"inerf", "inerf_dagger", "pnerf", "icomma"}
"""Their losses would take another exposure for geometry, and their steps here are few: they come nearer only."""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("room") / "room"), cache_dir=scene_cache)


@pytest.fixture(scope="module", params=ESTIMATORS.names())
def estimator(request: pytest.FixtureRequest) -> str:
    reason = ESTIMATORS.missing(request.param)
    if reason:
        pytest.skip(reason)
    return request.param


STEP_RENDERS = 4
"""What one step of any method renders at most."""


def photo_at(room: LoadedScene, pose: Pose, lens: Intrinsics = LENS, prior: Pose | None = None) -> Query:
    """A photo that nobody trained with: a render, darker and noisy."""
    rgb = room.rasterizer.render([Camera(lens, pose)])[0].rgb
    noise = np.random.default_rng(0).normal(0, 0.02, rgb.shape).astype(np.float32)
    return Query(to_uint8(0.85 * rgb + 0.04 + noise), lens, "given", lens, prior)


def unseen_pose(seed: int = 0) -> Pose:
    rng = np.random.default_rng(seed)
    pose = pose_at(rng.uniform(0, 2 * np.pi), 0.1)
    return moved(pose, np.concatenate([rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.15, 0.15, 3)]))


def assert_near(found: Pose, truth: Pose, degrees: float = 0.2, units: float = 0.01) -> None:
    """The room is 4 x 3 x 2.5. Seen: up to 0.05 degrees and 0.002."""
    angle, distance = pose_distance(found, truth)
    assert angle < degrees
    assert distance < units


def quick(estimator: str, **more: int) -> Request:
    """The estimator's defaults, but no longer than the near starts of these tests need."""
    options = ESTIMATORS.load(estimator).Options(**QUICK.get(estimator, {}))
    return Request(estimator, options, **more)


def brief(estimator: str, **more: int) -> Request:
    options = ESTIMATORS.load(estimator).Options(**QUICK.get(estimator, {}) | BRIEF.get(estimator, {}))
    return Request(estimator, options, **more)


def trace(records: tuple[IterationRecord, ...]) -> list[tuple]:
    return [(r.stage, r.pose.world_from_camera.tobytes(), r.num_matches, r.num_inliers) for r in records]


# --- every estimator


def test_finds_a_planted_pose_from_a_prior_nearby(estimator: str, room: LoadedScene) -> None:
    truth = unseen_pose()
    prior = moved(truth, np.array([0.05, -0.05, 0.03, 0.05, 0.02, -0.05]))
    query = photo_at(room, truth, prior=prior)
    if estimator in PHOTOMETRIC:
        query = replace(query, rgb=to_uint8(room.rasterizer.render([Camera(LENS, truth)])[0].rgb))
    found = localize(query, room, quick(estimator))
    if estimator in PHOTOMETRIC:
        assert pose_distance(prior, truth) == pytest.approx((4.4, 0.073), rel=0.01)
        assert_near(found.pose, truth, 1.0, 0.04)  # seen: 0.4 to 0.6 degrees, 0.02 to 0.03
    else:
        assert found.verdict.status is Status.LOCALIZED
        assert_near(found.pose, truth)


def test_the_trace_is_well_formed(estimator: str, room: LoadedScene) -> None:
    truth = unseen_pose(1)
    found = localize(photo_at(room, truth, prior=truth), room, brief(estimator))
    assert found.records
    for record in found.records:
        assert record.stage
        assert record.matches is None or len(record.matches.inlier) <= MatchVectors.LIMIT
        assert record.matches is None or record.num_matches is not None
        if record.candidates:
            assert len(record.candidates.scores) == len(record.candidates.world_from_camera)
            assert np.all(np.isfinite(record.candidates.scores))
    assert np.array_equal(found.records[-1].pose.world_from_camera, found.pose.world_from_camera)


def test_the_same_seed_gives_the_same_trace(estimator: str, room: LoadedScene) -> None:
    query = photo_at(room, unseen_pose(2), prior=unseen_pose(2))
    a, b = (localize(query, room, brief(estimator, seed=5)) for _ in range(2))
    assert trace(a.records) == trace(b.records)
    assert a.verdict.score == b.verdict.score


def test_can_be_stopped_at_any_record(estimator: str, room: LoadedScene) -> None:
    """Every record carries an answer; closing the generator early is no error."""
    plugin = ESTIMATORS.load(estimator)
    query = photo_at(room, unseen_pose(3), prior=unseen_pose(3))
    for count in (1, 2, 3):
        tools = Tools(room.scene, room.rasterizer, room.matcher, np.random.default_rng(0), room.prepare(estimator))
        steps = plugin.run(query, tools, brief(estimator).options)
        records = [record for record, _ in zip(steps, range(count), strict=False)]
        steps.close()
        assert all(isinstance(record.pose, Pose) for record in records)


def test_closed_it_keeps_nothing_of_the_job(estimator: str, room: LoadedScene) -> None:
    """Also while the closed generator is still there: its frame held photos, features and renders."""
    query = photo_at(room, unseen_pose(3), prior=unseen_pose(3))
    rasterizer = Counted(room.rasterizer, RenderTally())
    tools = Tools(room.scene, rasterizer, room.matcher, np.random.default_rng(0), room.prepare(estimator))
    steps = ESTIMATORS.load(estimator).run(query, tools, brief(estimator).options)
    for _ in range(3):
        next(steps, None)
    steps.close()
    alive = weakref.ref(rasterizer)
    del rasterizer, tools
    gc.collect()
    assert alive() is None
    assert steps is not None


def test_a_photo_without_texture_is_no_error(estimator: str, room: LoadedScene) -> None:
    blank = Query(np.full((HEIGHT, WIDTH, 3), 120, np.uint8), LENS, "given", LENS, unseen_pose())
    found = localize(blank, room, brief(estimator))
    assert found.verdict.status is Status.NOT_LOCALIZED
    assert found.verdict.reason is Reason.FEW_FEATURES


def test_the_budget_counts_renders(estimator: str, room: LoadedScene) -> None:
    """No more are made once it is reached than one step needs: at most a batch of a few poses."""
    query = photo_at(room, unseen_pose(3), prior=moved(unseen_pose(3), np.array([0.03, 0.02, 0, 0, 0.02, 0])))
    free = localize(query, room, brief(estimator))
    assert not free.budget_exhausted
    stopped = localize(query, room, brief(estimator, budget_renders=2))
    assert 2 <= stopped.renders <= 2 + STEP_RENDERS
    assert stopped.budget_exhausted
    assert stopped.renders <= free.renders


# --- the default: no prior at all


@pytest.mark.parametrize("seed", range(4))
def test_needs_no_prior(seed: int, room: LoadedScene) -> None:
    truth = unseen_pose(seed)
    found = localize(photo_at(room, truth), room)
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)
    assert found.verdict.covariance is not None
    assert [record.stage for record in found.records][:2] == ["retrieve", "match"]


def test_another_matcher_will_do(room: LoadedScene) -> None:
    other = LoadedScene.of(replace(room.scene, cameras=room.scene.cameras[::2]), matcher="sift")
    found = localize(photo_at(other, unseen_pose(1)), other)
    assert found.matcher == "sift"
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, unseen_pose(1))


@pytest.mark.parametrize("degrees", [45, 90, 180, 260])
def test_a_turned_photo_is_found_by_turning_it(degrees: int, room: LoadedScene) -> None:
    truth = moved(unseen_pose(4), np.array([0, 0, np.radians(degrees), 0, 0, 0]))
    found = localize(photo_at(room, truth), room)
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)
    assert degrees == 45 or "retrieve_rotated" in {
        record.stage for record in found.records
    }  # features stand an eighth here


def test_what_a_small_photo_does_not_show_is_looked_for_in_its_full_size(room: LoadedScene) -> None:
    """Of two photos with four times the focal length: each shows a few patches of one wall."""
    zoomed = replace(LENS, fx=4 * FOCAL, fy=4 * FOCAL)
    stages: set[str] = set()
    for seed in (4, 5):
        found = localize(photo_at(room, unseen_pose(seed), zoomed), room)
        assert_near(found.pose, unseen_pose(seed))
        stages |= {record.stage for record in found.records}
    assert "retrieve_full_size" in stages
    assert not stages & {"retrieve_more_views", "retrieve_rotated", "sample_poses"}


def test_a_refinement_that_does_not_settle_is_followed_by_another_match(room: LoadedScene) -> None:
    """Of a photo whose lens is free: here it would settle with some more rounds."""
    once = replace(SEARCH, refinement=replace(SEARCH.refinement, max_renders=1))
    photo = photo_at(room, unseen_pose(4))
    lens = replace(photo.intrinsics, fx=1.05 * FOCAL, fy=1.05 * FOCAL, trust="approximate")
    found = localize(replace(photo, intrinsics=lens, photo_intrinsics=lens), room, Request(config=once))
    stages = [record.stage for record in found.records]
    assert stages[stages.index("refine") + 1] == "rematch"
    assert_near(found.pose, unseen_pose(4))


@pytest.mark.ci
def test_a_photo_half_hidden_is_found_or_refused_but_never_wrong(room: LoadedScene) -> None:
    truth = unseen_pose(5)
    query = photo_at(room, truth)
    for share in (0.2, 0.35, 0.6):
        rgb = query.rgb.copy()
        rgb[:, : int(share * WIDTH)] = [200, 30, 30]
        found = localize(replace(query, rgb=rgb), room)
        if found.verdict.status is Status.LOCALIZED:
            assert_near(found.pose, truth, 0.5, 0.02)
        assert share > 0.2 or found.verdict.status is Status.LOCALIZED


def test_a_photo_of_another_place_is_not_localized(room: LoadedScene, tmp_path: Path) -> None:
    """The room painted anew: same geometry, other pictures on the walls."""
    rng = np.random.default_rng(8)
    scene = room.scene
    shuffled = replace(scene, sh=np.asarray(scene.sh)[rng.permutation(scene.count)])
    foreign = LoadedScene.of(shuffled)
    found = localize(photo_at(foreign, unseen_pose()), room)
    assert found.verdict.status is Status.NOT_LOCALIZED
    assert found.verdict.score < 0.25
    assert not {record.stage for record in found.records}.isdisjoint({"retrieve_rotated", "retrieve_more_views"})
    for effort in ("fast", "exhaustive"):
        request = Request(options=ESTIMATORS.load(DEFAULT).Options(effort=effort), budget_renders=25)
        stages = {record.stage for record in localize(photo_at(foreign, unseen_pose()), room, request).records}
        assert ("sample_poses" in stages) is (effort == "exhaustive")


@pytest.mark.ci
def test_of_two_rooms_the_one_that_the_photo_shows_is_named(room: LoadedScene, tmp_path: Path) -> None:
    other = LoadedScene.of(replace(room.scene, sh=room.scene.sh[::-1]))  # the same walls, painted otherwise
    photo = photo_at(room, unseen_pose())
    told: list[IterationRecord] = []
    for scenes in ([other, room], [room, other]):
        told.clear()
        found = localize_in_scenes(photo, scenes, on_record=told.append)
        assert found.loaded is room
        assert found.estimate.verdict.status is Status.LOCALIZED
        assert_near(found.estimate.pose, unseen_pose())
        assert len(found.estimate.scene_ranking) == 2
        assert tuple(told) == found.estimate.records
    noise = np.random.default_rng(0).integers(0, 256, photo.rgb.shape).astype(np.uint8)
    nowhere = localize_in_scenes(replace(photo, rgb=noise), [other, room]).estimate
    assert nowhere.verdict.status is Status.NOT_LOCALIZED
    assert nowhere.pose is not None
    turned = replace(photo, rgb=np.rot90(photo.rgb).copy(), intrinsics=LENS_UPRIGHT)
    assert localize_in_scenes(turned, [other, room]).loaded is room


@pytest.mark.ci
def test_without_training_cameras_the_room_is_found_from_the_inside(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ViewpointConfig(placement=PlacementConfig(shell_candidates=20, volume_candidates=80, best=20))
    monkeypatch.setattr("service.estimators.view_index.prepared_index", partial(prepared_index, viewpoints=few))
    bare = LoadedScene.of(replace(room.scene, cameras=()))
    half = np.array([2.0, 1.5, 1.25])
    # The scene's picture is taken from outside until there is an index, for which it doesn't wait.
    before = overview(bare, 480)
    views = bare.prepare(DEFAULT).views
    inside = [np.all(np.abs(view.camera.pose.position_in_world) < half) for view in views]
    assert np.mean(inside) > 0.5
    shown = overview(bare, 480)
    assert np.any(np.abs(before.pose.position_in_world) > half)
    assert np.all(np.abs(shown.pose.position_in_world) < half)
    located = [localize(photo_at(bare, unseen_pose(seed)), bare) for seed in range(3)]
    for seed, found in enumerate(located):
        assert found.verdict.status is Status.LOCALIZED
        assert_near(found.pose, unseen_pose(seed))


def test_a_prior_is_one_more_candidate_and_may_be_wrong(room: LoadedScene) -> None:
    truth = unseen_pose(2)
    right = localize(photo_at(room, truth, prior=truth), room)
    away = moved(truth, np.array([0, 2.5, 0, 0, 0, 0]))
    wrong = localize(photo_at(room, truth, prior=away), room)
    for found in (right, wrong):
        assert found.verdict.status is Status.LOCALIZED
        assert_near(found.pose, truth)
    assert len(right.records) <= len(wrong.records)


@pytest.mark.parametrize("option", [{"candidates": 0}, {"candidates": 65}, {"effort": "heroic"}])
def test_senseless_options_are_refused(option: dict) -> None:
    with pytest.raises(InvalidOptions, match=next(iter(option))):
        ESTIMATORS.load(DEFAULT).Options(**option)


def test_a_cut_out_of_the_photo_is_found(room: LoadedScene) -> None:
    """A zoomed photo is looked at in the scale of the views; what is masked is not judged."""
    truth = unseen_pose(6)
    zoomed = replace(LENS, fx=2 * LENS.fx, fy=2 * LENS.fy)
    query = photo_at(room, truth, zoomed)
    known = np.ones(query.rgb.shape[:2], bool)
    known[:, : WIDTH // 3] = False
    rgb = np.where(known[..., None], query.rgb, np.uint8(255))
    found = localize(replace(query, rgb=rgb, valid_mask=known), room)
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)


# --- the supplement's method


@pytest.mark.parametrize("solver", ["least_squares", "gradient"])
def test_mc_do_leaves_out_what_is_switched_off(solver: str, room: LoadedScene) -> None:
    truth = unseen_pose(1)
    query = photo_at(room, truth, prior=moved(truth, np.array([0.1, 0.1, 0, 0.1, 0, 0])))
    kinds = {"hypotheses": "hypothesis", "iterations": "decouple", "refinement_steps": "refine"}
    for left in kinds:
        amounts = {name: 3 if name == left else 0 for name in kinds}
        options = ESTIMATORS.load("mc_do").Options(**amounts, rounds=0, solver=solver)
        found = localize(query, room, Request("mc_do", options))
        stages = {record.stage for record in found.records}
        assert kinds[left] in stages
        assert stages <= {"start", "sample_poses", kinds[left]}
        assert all(record.matches for record in found.records if record.stage in ("hypothesis", "decouple"))


def test_mc_do_comes_back_from_the_hard_protocol(room: LoadedScene) -> None:
    """Here the motion about the centre turns a camera that looks outwards to another wall."""
    truth = unseen_pose(2)
    away = moved(truth, np.array([0.0, 0.6, 0.1, 0.2, 0.0, 0.0]))
    options = ESTIMATORS.load("mc_do").Options(refinement_steps=20)
    found = localize(photo_at(room, truth, prior=away), room, Request("mc_do", options))
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_rests_at_the_planted_truth(name: str, room: LoadedScene) -> None:
    """The gradient there against that a degree beside: seen 3e-5 and less, 0.006 for l1, which knows no size."""
    truth = unseen_pose(1)
    loss = loss_against(name, to_uint8(room.rasterizer.render([Camera(LENS, truth)])[0].rgb))
    beside = moved(truth, np.array([0, np.radians(1), 0, 0, 0, 0]))
    at_truth, at_degree = (
        np.linalg.norm(loss_and_gradient(room.rasterizer, LENS, pose, loss)[1]) for pose in (truth, beside)
    )
    assert at_degree > 0
    assert at_truth < (0.03 if name == "l1" else 3e-4) * at_degree


def test_mc_do_may_sample_the_whole_scene_beside_a_prior(room: LoadedScene) -> None:
    truth = unseen_pose(2)
    wrong = moved(truth, np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    options = ESTIMATORS.load("mc_do").Options(around="scene", refinement_steps=10)
    found = localize(photo_at(room, truth, prior=wrong), room, Request("mc_do", options))
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)


@pytest.mark.parametrize(
    ("name", "value"), [("hypotheses", -1), ("solver", "newton"), ("around", "nothing"), ("loss", "l3")]
)
def test_mc_do_refuses_senseless_options(name: str, value: object) -> None:
    with pytest.raises((InvalidOptions, UnknownName), match=str(value) if name != "hypotheses" else name):
        ESTIMATORS.load("mc_do").Options(**{name: value})


# --- the baselines


@pytest.mark.parametrize("estimator", sorted(PHOTOMETRIC))
def test_a_baseline_without_a_prior_says_so(estimator: str, room: LoadedScene) -> None:
    with pytest.raises(InvalidPrior, match=f"'{estimator}' moves a given pose"):
        localize(photo_at(room, unseen_pose()), room, quick(estimator))


@pytest.mark.parametrize("estimator", sorted(PHOTOMETRIC))
@pytest.mark.parametrize("name", ["steps", "long_side_px", "loss"])
def test_a_baseline_refuses_senseless_options(estimator: str, name: str) -> None:
    with pytest.raises((InvalidOptions, UnknownName), match="l3" if name == "loss" else name):
        ESTIMATORS.load(estimator).Options(**{name: "l3" if name == "loss" else -1})


def test_the_supplements_parameters_are_the_defaults() -> None:
    inerf, dagger, pnerf, icomma = (
        ESTIMATORS.load(name).Options() for name in ("inerf", "inerf_dagger", "pnerf", "icomma")
    )
    assert (inerf.steps, inerf.rays, inerf.rate, inerf.loss) == (500, 512, 0.05, "l2")
    assert (dagger.steps, dagger.rate, dagger.loss) == (500, 0.05, "l2")
    assert (pnerf.steps, pnerf.resample_every, pnerf.turn_rate, pnerf.shift_rate) == (2560, 512, 5e-3, 3e-3)
    assert (icomma.steps, icomma.rematch_every, icomma.loss) == (500, 1, "l2")


def test_icomma_stops_matching_when_the_matches_are_close(room: LoadedScene) -> None:
    truth = unseen_pose(1)
    query = photo_at(room, truth, prior=moved(truth, np.array([0.04, 0, 0, 0, 0.03, 0])))
    stages = [r.stage for r in localize(query, room, quick("icomma")).records]
    last_match = max(i for i, stage in enumerate(stages) if stage == "match")
    assert set(stages[last_match + 1 :]) == {"compare"}
    assert last_match < len(stages) / 2


def test_pnerf_draws_new_hypotheses_around_the_best(room: LoadedScene) -> None:
    truth = unseen_pose(1)
    options = ESTIMATORS.load("pnerf").Options(hypotheses=12, steps=33, resample_every=32, long_side_px=64)
    found = localize(photo_at(room, truth, prior=truth), room, Request("pnerf", options))
    shown = [r.candidates for r in found.records if r.candidates]
    nearest = [_to_nearest(shown[0]), _to_nearest(shown[-1])]
    assert len(shown[0].scores) == 12
    assert np.median(nearest[0]) > 5  # within +-15 degrees an axis
    assert np.max(nearest[1]) < 3 * np.sqrt(3) + 1  # a parent or a child has one within +-3 degrees
    assert found.renders == 33 * 12 * 2


def _to_nearest(candidates: Candidates) -> list[float]:
    """Degrees from each pose to the one of the others that is turned most like it."""
    poses = [Pose(matrix) for matrix in candidates.world_from_camera]
    return [min(pose_distance(a, b)[0] for b in poses if b is not a) for a in poses]


@pytest.mark.parametrize("name", ["inerf", "icomma"])
def test_a_method_that_needs_a_prior_warms_up(room, name, caplog):
    """As a service does whose SPLATFIX_ESTIMATOR is such a method."""
    with caplog.at_level("INFO"):
        warm_up(room, name)
    assert "warmed up" in caplog.text
