"""The ablation bench: each removal changes the estimator, and leaves the default as it is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_room import write_room
from test_bench import estimate
from test_estimators import LENS_UPRIGHT, photo_at, unseen_pose

from service.bench import ablation
from service.bench.ablation import CONDITIONS, Removal, removals, run, table, unscaled_dilation
from service.bench.pose_metrics import Units
from service.errors import UnknownName
from service.geometry import look_at, moved, pose_distance, project, transformed
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.match_stages import MATCHING, solve_matches_near
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.render import cpu
from service.results import PoseEstimate
from service.types import Camera, Intrinsics, Pose, Query, SceneInfo

LENS = Intrinsics(512, 384, 500.0, 500.0, 256.0, 192.0)


def test_each_part_is_removed_by_another_value() -> None:
    parts = removals()
    floors = parts["local colour correlation"].config.verification.model.floors
    assert set(SHIPPED_MODEL.floors) - set(floors) == {"local_colour_correlation"}
    assert parts.pop("nothing") == Removal()
    assert all(removal != Removal() for removal in parts.values())
    assert len({repr(removal) for removal in parts.values()}) == len(parts)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("ablation") / "room"), cache_dir=scene_cache)


def without(part: str, room: LoadedScene, query: Query | None = None) -> PoseEstimate:
    removal = removals()[part]
    return localize(
        query or photo_at(room, unseen_pose()), room, Request(options=removal.options, config=removal.config)
    )


@pytest.mark.ci
def test_what_is_removed_leaves_no_trace(room: LoadedScene) -> None:
    whole = without("nothing", room)
    refined = [record.loss for record in whole.records if record.stage == "refine"]
    assert len(refined) > 1
    assert None not in refined
    assert [r.loss for r in without("photometric refinement", room).records if r.stage == "refine"] == [None]
    single = without("second render of the refinement", room)
    stages = [record.stage for record in single.records]
    assert "refine" in stages
    assert ("refine", "refine") not in pairwise(stages)
    assert without("small first render", room).renders >= 1
    # With matches verified, too, the verdict counts those with a render at the pose.
    assert "inliers" in without("verification by pixels after many matches", room).verdict.signals
    assert "inliers" not in whole.verdict.signals
    turned = replace(query := photo_at(room, unseen_pose()), rgb=np.rot90(query.rgb).copy(), intrinsics=LENS_UPRIGHT)
    assert "retrieve_rotated" in {record.stage for record in without("nothing", room, turned).records}
    assert "retrieve_rotated" not in {record.stage for record in without("in-plane rotation", room, turned).records}
    assert "sample_poses" not in {r.stage for r in without("sampled poses (effort fast)", room, turned).records}


def test_the_dilation_is_unscaled_for_a_run_only() -> None:
    info = SceneInfo("s", "s", "0" * 64, "ply", training_focal_px=2 * LENS.fx)
    camera = Camera(LENS, Pose(np.eye(4)))
    scaled = cpu.dilation_for(camera, info)
    with unscaled_dilation():
        assert cpu.dilation_for(camera, info) == pytest.approx(4 * scaled)
    assert cpu.dilation_for(camera, info) == scaled


def test_the_decoupled_solver_and_its_stand_in_find_the_planted_pose_among_wrong_matches() -> None:
    rng = np.random.default_rng(0)
    truth = look_at(np.array([0.0, -4.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    points = rng.uniform(-1, 1, (200, 3)).astype(np.float32)
    px = project(transformed(truth.camera_from_world, points.astype(np.float64)), LENS)
    px[:60] = rng.uniform(0, [512, 384], (60, 2))
    matches = Correspondences(px.astype(np.float32), px.astype(np.float32), points)
    near = AbsolutePose(moved(truth, np.array([0.03, -0.02, 0.02, 0.1, 0.05, -0.1])), np.ones(200, bool))
    query = Query(
        rgb=np.zeros((384, 512, 3), np.uint8), intrinsics=LENS, photo_intrinsics=LENS, intrinsics_source="given"
    )
    without = removals()["decoupled solver (PnP instead)"].config.matching
    assert without.solver != MATCHING.solver
    for config in (MATCHING, without):
        found = solve_matches_near(near, matches, query, config)
        assert found is not None
        degrees, units = pose_distance(found.pose, truth)
        # float32 pixels; seen 1e-5 and 1e-6
        assert degrees < 1e-3
        assert units < 1e-4
        assert found.inlier[60:].all()


def test_the_table_has_a_line_a_part_and_counts_what_is_false() -> None:
    rows = [
        {
            "part": part, "condition": condition, "photos": 4, "success_5deg_0p05": 3, "success_1deg_0p01": 2,
            "false_localized": int(condition == "clean"), "cpu_ms_p50": 98.6,
        }
        for part in ("nothing", "alignment") for condition in CONDITIONS
    ]  # fmt: skip
    lines = table(rows).splitlines()
    assert len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1  # else it is no table
    assert lines[3] == "| alignment |" + " 3 / 2 |" * len(CONDITIONS) + " 1 | 99 |"


def test_an_unknown_part_is_named() -> None:
    with pytest.raises(UnknownName, match="in-plane rotation"):
        run([], parts=["wheels"])


# ------------------------------------------------------------------ a whole run, with planted answers


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Every photo is localized 0.02 units off, a second one by a run without `render and rematch` 1 unit off."""
    seen = SimpleNamespace(prepared=[], occluders=[], asked=[], scaled=[], progress=[])
    truth = Camera(LENS, unseen_pose())

    def load_bench_scene(folder: Path, cameras: str = "given", cache_dir: Path | None = None):
        loaded = SimpleNamespace(prepare=lambda estimator: seen.prepared.append((str(folder), cameras)))
        return SimpleNamespace(loaded=loaded, photos="pq", units=Units(np.zeros(3), 0.5, False), cameras=cameras)

    def make_trials(one, start, count, seed, modify, occluders):
        seen.occluders.append((str(occluders), modify, one.cameras))
        return iter([SimpleNamespace(photo=name, truth=truth) for name in "pq"[:count]])

    def localize_trial(one, trial, request, trust):
        seen.asked.append((one.cameras, trust, request.options.effort))
        info = SceneInfo("s", "s", "0" * 64, "ply")
        seen.scaled.append(cpu.dilation_for(Camera(LENS.resized(80, 60), truth.pose), info))
        wrong = request.config.rematch_below_inliers == 0 and trial.photo == "q"
        return estimate(moved(truth.pose, np.array([0, 0, 0, 2.0 if wrong else 0.04, 0, 0])))

    monkeypatch.setattr(ablation, "load_bench_scene", load_bench_scene)
    monkeypatch.setattr(ablation, "make_trials", make_trials)
    monkeypatch.setattr(ablation, "localize_trial", localize_trial)
    return seen


def test_every_part_answers_every_condition_of_every_scene(
    planted: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = ["nothing", "render and rematch", "estimation of the focal length", "scaled dilation"]
    folders = [Path("a"), Path("b"), Path("c")]
    now = [0.0]

    def later() -> float:
        now[0] += 1.0
        return now[0]

    # Each localization takes a second of processor time.
    monkeypatch.setattr(ablation, "time", SimpleNamespace(perf_counter=lambda: 0.0, process_time=later))
    rows = run(folders, parts=parts, progress=lambda *now: planted.progress.append(now))
    assert [(row["part"], row["condition"]) for row in rows] == [(part, each) for part in parts for each in CONDITIONS]
    assert all(row["photos"] == 6 for row in rows)
    for row in rows:
        # Half a normalized unit a scene unit: 0.02 units are right, but not within 0.01.
        right = 3 if row["part"] == "render and rematch" else 6
        assert (row["success_5deg_0p05"], row["success_1deg_0p01"]) == (right, 0)
        assert row["false_localized"] == 6 - right
        assert row["cpu_ms_p50"] == 1000
    count = len(CONDITIONS)
    assert planted.progress == [(done, 3 * count) for done in range(1, 3 * count + 1)]
    # The next scene's photos hide those of each, and those of the first hide the last one's.
    assert [occluders for occluders, _, _ in planted.occluders] == [*"b" * count, *"c" * count, *"a" * count]
    # Before the photos, and so without its time in theirs.
    assert set(planted.prepared) == {(name, cameras) for name in "abc" for cameras in ("given", "ignored")}
    assert [modify for _, modify, _ in planted.occluders[:count]] == list(CONDITIONS.values())
    assert [cameras for _, _, cameras in planted.occluders] == [*["given"] * (count - 1), "ignored"] * 3
    # The focal length is approximate in its own condition, but for the part that takes it as exact.
    approximate = [i for i, (_, trust, _) in enumerate(planted.asked) if trust == "approximate"]
    first = list(CONDITIONS).index("focal 5 % off") * len(parts) * 2
    assert approximate[:6] == [first, first + 1, first + 2, first + 3, first + 6, first + 7]
    assert len(approximate) == 18
    # Without scaled dilation a render of a fifth of the size has the training photos'.
    assert len(set(planted.scaled[:6])) == 1
    assert set(planted.scaled[6:8]) == {cpu.DEFAULTS.dilation_px2} != set(planted.scaled[:6])


def test_all_parts_are_removed_if_none_is_named(planted: SimpleNamespace) -> None:
    rows = run([Path("a")])
    assert {row["part"] for row in rows} == set(removals())
    assert [row["photos"] for row in rows] == [2] * len(rows)
    assert planted.occluders[0][0] == "a"  # a single scene's photos hide its own
    assert sum(effort == "fast" for _, _, effort in planted.asked) == 2 * len(CONDITIONS)
