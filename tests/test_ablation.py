"""The ablation bench: what stands in for a part is there during a run only, and does what its name says."""

from __future__ import annotations

import numpy as np
import pytest

from service.bench import ablation
from service.bench.ablation import CONDITIONS, removals, run, table
from service.errors import UnknownName
from service.geometry import look_at, moved, pose_distance, project, transformed
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.matching import search_stages as stages
from service.pose.matching.correspondences import Correspondences
from service.types import Intrinsics, Query

LENS = Intrinsics(512, 384, 500.0, 500.0, 256.0, 192.0)


@pytest.mark.parametrize("part", removals())
def test_a_part_is_removed_for_a_run_only(part: str) -> None:
    patches = removals()[part].patches
    before = [vars(place)[name] for place, name, _ in patches]
    with ablation._patched(patches):
        assert all(vars(place)[name] is stand_in for place, name, stand_in in patches)
        assert not any(vars(place)[name] is old for (place, name, _), old in zip(patches, before, strict=True))
    assert all(vars(place)[name] is old for (place, name, _), old in zip(patches, before, strict=True))


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
    for solve in (stages.solved_near, ablation._resected_again):
        found = solve(near, matches, query)
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
    assert lines[3] == "| alignment |" + " 3 / 2 |" * len(CONDITIONS) + " 1 | 99 |"


def test_an_unknown_part_is_named() -> None:
    with pytest.raises(UnknownName, match="photo turned"):
        run([], parts=["wheels"])
