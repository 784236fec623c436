"""Figures of the benches by hand: of the machine, coverage maps, the gate's fit, a simulated fleet, modified scenes."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_bench import LENS, poses
from test_gate_bench import sample as leveled

from service.bench import (
    coverage,
    device,
    fleet_simulation,
    gate_fit,
    large_scenes,
    miss_images,
    modifications,
    scene_modifications,
)
from service.bench import localize as bench
from service.bench.fleet_simulation import FleetModel, FleetSimulation
from service.bench.gate_fit import FIT, Sample
from service.bench.gpu_shared import every, finite
from service.bench.modified_photo import Photo
from service.bench.pose_files import read_names, read_pose_file
from service.bench.pose_metrics import Outcome, Units
from service.errors import InvalidRequest, SceneNotFound
from service.pose.verification.gate import VERIFICATION
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.results import Status
from service.scene_formats.gaussians import RawGaussians
from service.types import SH_C0, GaussianScene, Intrinsics, SceneInfo


def float32s(values: Any) -> np.ndarray:
    return np.array(values, np.float32)


# ------------------------------------------------------------------ the machine


def outcome(latency_ms: float, degrees: float = 0.5) -> Outcome:
    return Outcome(Status.LOCALIZED, degrees, 0.005, latency_ms, latency_ms / 3)


@pytest.mark.parametrize(("first_ms", "count"), [(600.0, 3), (4000.0, 1), (140.0, 5)])
def test_as_many_photos_are_measured_as_fit_into_the_time(
    first_ms: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[list[str]] = []

    def measure(trials: Any, localize_one: Any, units: Any) -> Any:
        calls.append([localize_one(trial) for trial in trials])
        times = [first_ms] if len(calls) == 1 else [100.0 * k for k in range(1, len(trials) + 1)]
        lines = [{"stages_ms": {"search": 3.0 * k + 1} | ({"refine": 7.0} if k else {})} for k in range(len(trials))]
        return [outcome(ms) for ms in times], lines

    monkeypatch.setattr(device, "measure", measure)
    monkeypatch.setattr(device, "localize_trial", lambda one, trial, request, kind: f"{trial} {kind}")
    found = device._measured(SimpleNamespace(units=None), list("abcde"), "withheld", 2.0)  # type: ignore[arg-type]
    assert calls == [["a withheld"], [f"{name} withheld" for name in "abcde"[:count]]]
    assert found["queries"] == count
    assert found["latency_ms_p50"] == 100 * (count + 1) / 2
    stages = {"search": 3 * (count - 1) / 2 + 1} | ({"refine": 7.0} if count > 1 else {})
    assert found["stages_ms_p50"] == stages


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A machine with a planted clock, scene and figures."""
    seen = SimpleNamespace(prepared=[], trials=[], measured=[], now=iter([5.0, 8.5]))
    info = SimpleNamespace(name="studio")
    loaded = SimpleNamespace(
        prepare=seen.prepared.append, rasterizer=SimpleNamespace(name="r"), scene=SimpleNamespace(info=info)
    )
    one = SimpleNamespace(loaded=loaded, photos=("p", "q", "s"))

    def measured(bench_scene: Any, trials: Any, kind: str, limit_s: float) -> dict[str, Any]:
        seen.measured.append((trials, kind, limit_s))
        figures = {"queries": 8, "localized": 7, "false_localized": 1, "success_1deg_0p01": 0.75}
        figures |= {"median_rotation_deg": 0.1234, "median_translation_units": 0.00567}
        return figures | {"latency_ms_p50": 45.4, "latency_ms_p95": 99.6, "stages_ms_p50": {"search": 30.25, "gate": 4}}

    monkeypatch.setattr(device, "load_bench_scene", lambda folder: one)
    monkeypatch.setattr(device, "make_trials", lambda *asked: iter([asked[1:]]))
    monkeypatch.setattr(device, "_measured", measured)
    monkeypatch.setattr(device, "time", SimpleNamespace(perf_counter=lambda: next(seen.now)))
    monkeypatch.setattr(device, "RASTERIZERS", SimpleNamespace(load=lambda name: seen.module))
    monkeypatch.setattr(device, "versions", lambda: {"splatfix": "1.2", "python": "3.11", "numpy": "2.1", "numba": "0"})
    seen.module = SimpleNamespace(device_facts=lambda: {"name": "H9"})
    return seen


def test_a_machine_is_measured_with_and_without_intrinsics_in_half_of_the_time_each(measured: SimpleNamespace) -> None:
    shown: list[tuple[int, int]] = []
    found = device.run(Path("s"), processor="a fast one", limit_s=7.0, progress=lambda *now: shown.append(now))
    assert measured.prepared == ["view_index"]
    assert measured.measured == [([("none", 3, 0)], "given", 3.5), ([("none", 3, 0)], "withheld", 3.5)]
    assert shown == [(1, 2), (2, 2)]
    assert (found["prepare_s"], found["gpu"], found["renderer"], found["scene"]) == (3.5, "H9", "r", "studio")
    assert found["date"] == datetime.now(UTC).date().isoformat()
    found |= {"system": "Linux", "machine": "arm", "release": "6", "date": "2031-02-03"}
    lines = device.block(found).split("\n")
    assert lines[:5] == [
        "splatfix 1.2, 2031-02-03, Linux arm (6), Python 3.11",
        "a fast one",
        "renderer r on H9",
        "numpy 2.1, numba 0",
        "studio: loaded and indexed in 3.5 s",
    ]
    assert lines[5] == (
        "intrinsics given: 7 of 8 localized, 1 wrongly, 6 within 1 deg and 0.01 units; median error 0.123 deg, "
        "0.0057 units"
    )
    assert lines[6] == "  ms a photo: median 45, 95 % 100; by stage: search 30.2, gate 4.0"
    assert len(lines) == 9


def test_a_renderer_without_a_device_has_no_gpu(measured: SimpleNamespace) -> None:
    measured.module = SimpleNamespace()
    found = device.run(Path("s"), processor="x", emulated=True)
    lines = device.block(found).split("\n")
    assert (found["gpu"], lines[1], lines[2]) == ("", "x, EMULATED", "renderer r")
    assert [limit for *_, limit in measured.measured] == [30.0, 30.0]


# ------------------------------------------------------------------ coverage maps


@pytest.mark.parametrize("photos", [0, 2])
def test_a_map_predicts_of_each_photo_what_the_others_tell(photos: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def left_out(rates: np.ndarray, found: np.ndarray) -> np.ndarray:
        assert found.tolist() == [True, False]
        return rates / 4

    real = [SimpleNamespace(photo="a", found=True), SimpleNamespace(photo="b", found=False)]
    trials = [SimpleNamespace(found=value) for value in (True, True, False, True, False)]
    found: Any = SimpleNamespace(
        real_trials=real, rates_near=lambda trials: np.array([0.8, 0.4]), trials=trials, title="a map", seconds=9.0,
        calibration=SimpleNamespace(photos=photos), expected_accuracy=lambda: SimpleNamespace(sure_share=0.3),
    )  # fmt: skip
    monkeypatch.setattr(coverage, "left_out", left_out)
    row = coverage.scene_row("room", found)
    predicted = [0.2, 0.1] if photos else [0.8, 0.4]
    assert [(each["photo"], each["predicted"], each["uncalibrated"], each["found"]) for each in row["photos"]] == [
        ("a", predicted[0], 0.8, True), ("b", predicted[1], 0.4, False),
    ]  # fmt: skip
    assert (row["renders_found"], row["sure_share"], row["seconds"]) == (0.6, 0.3, 9.0)
    assert row["brier_uncalibrated"] == pytest.approx((0.2**2 + 0.4**2) / 2)
    found.trials = []
    assert coverage.scene_row("room", found)["renders_found"] is None


# ------------------------------------------------------------------ the gate's fit


def sample(scene: str = "s", photo: str = "p", right: bool = True, tracked: bool | None = None) -> Sample:
    return Sample(scene, "clean", photo, right, {}, False, None, tracked)


def test_folds_are_scenes_or_a_quarter_of_the_photos_of_a_single_one() -> None:
    assert gate_fit._folds([sample("b"), sample("a"), sample("c"), sample("a")]).tolist() == [1, 0, 2, 0]
    photos = [sample("s", name) for name in "afcbdeaf"]
    assert gate_fit._folds(photos).tolist() == [0, 1, 2, 1, 3, 0, 0, 1]
    assert gate_fit._folds([]).tolist() == []


def test_the_fit_is_where_the_penalized_likelihood_is_flat() -> None:
    """By finite differences of what the fit's docstrings state: the classes weigh alike, the bias has no penalty."""
    rng = np.random.default_rng(0)
    features = np.concatenate([np.ones((60, 1)), rng.uniform(size=(60, 2))], 1)
    right = np.r_[np.ones(13, bool), np.zeros(47, bool)]
    features[:13, 1:] += [0.4, 0.5]
    found = gate_fit.fitted(features, right)
    assert (found[1:] > 0).all()

    def objective(weights: np.ndarray) -> float:
        p = 1 / (1 + np.exp(-(features @ weights)))
        likelihood = 30 * np.mean(np.log(p[:13])) + 30 * np.mean(np.log(1 - p[13:]))
        return float(likelihood - 0.5 * FIT.penalty * 0.6 * (weights[1:] ** 2).sum())

    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        assert abs(objective(found + step) - objective(found - step)) / 2e-4 < 1e-5
    # Separable classes, whose weights the penalty alone bounds; one class alone.
    separable = np.c_[np.ones(4), [0.0, 0.1, 0.9, 1.0]]
    assert 5 < gate_fit.fitted(separable, np.array([False, False, True, True]))[1] < 1000
    assert np.isfinite(gate_fit.fitted(separable, np.ones(4, bool))).all()


def test_logistic_values_by_hand() -> None:
    found = gate_fit.probabilities(np.array([[1.0, 2.0], [1.0, -3.0]]), np.array([0.5, 0.25]))
    assert found == pytest.approx([0.731058579, 0.437823499])  # of 1 and -0.25


def test_what_is_called_localized_is_counted_by_kind() -> None:
    low, at = VERIFICATION.min_localized - 0.01, VERIFICATION.min_localized
    rows = [
        ("clean", True, at, False), ("clean", True, at, False), ("clean", True, low, False), ("clean", True, at, True),
        ("clean", False, at, False), ("moved", False, low, False), ("moved", False, at, False),
        ("moved", True, at, False), ("foreign", False, at, False), ("foreign", False, low, False),
        ("garbage", False, at, False), ("moved", False, at, False),
    ]  # fmt: skip
    kinds, right, tested, doubted = (np.array(column) for column in zip(*rows, strict=True))
    found = gate_fit._counts(tested, right, kinds, doubted)
    by_kind = found.pop("by_kind")
    assert found == {
        "foreign_or_garbage": 3, "foreign_or_garbage_localized": 2, "wrong": 4, "wrong_localized": 3,
        "right": 5, "right_localized": 3,
    }  # fmt: skip
    assert by_kind["clean"] == {"right": 4, "right_localized": 2, "wrong": 1, "wrong_localized": 1}
    assert by_kind["moved"] == {"right": 1, "right_localized": 1, "wrong": 3, "wrong_localized": 2}
    assert by_kind["foreign"] == {"right": 0, "right_localized": 0, "wrong": 2, "wrong_localized": 1}
    assert set(by_kind) == {"clean", "moved", "foreign", "garbage"}


def test_a_reliability_diagram_has_a_row_for_each_tenth_that_occurs() -> None:
    tested, right = np.array([0.31, 0.39, 0.35, 0.62, 1.0]), np.array([True, False, False, True, True])
    assert gate_fit._reliability(tested, right) == [
        {"from": 0.3, "to": 0.4, "count": 3, "said": pytest.approx(0.35), "true": pytest.approx(1 / 3)},
        {"from": 0.6, "to": 0.7, "count": 1, "said": 0.62, "true": 1.0},
        {"from": 0.9, "to": 1.0, "count": 1, "said": 1.0, "true": 1.0},
    ]
    assert gate_fit._tracked_counts(
        [sample(right=right, tracked=tracked) for right, tracked in ((True, True), (True, False), (True, True),
                                                                     (False, True), (False, False), (False, False))]
    ) == {"right": 3, "right_localized": 2, "wrong": 3, "wrong_localized": 1}  # fmt: skip


def test_tracked_poses_are_counted_apart_and_fitted_on_nowhere() -> None:
    levels = [(True, 0.8 + 0.02 * k) for k in range(9)] + [(False, 0.03 * k) for k in range(7)]
    samples = [leveled(scene, "moved", right, level) for scene in "ab" for right, level in levels]
    tracked = [(True, True), (True, False), (True, True), (False, False), (False, True)]
    both = samples + [replace(leveled("c", "tracked", right, 0.5), tracked=said) for right, said in tracked]
    found, alone = gate_fit.summary(both, SHIPPED_MODEL), gate_fit.summary(samples, SHIPPED_MODEL)
    assert found["tracked"] == {"right": 3, "right_localized": 2, "wrong": 2, "wrong_localized": 1}
    assert alone["tracked"] == {"right": 0, "right_localized": 0, "wrong": 0, "wrong_localized": 0}
    assert (found["photometric"], found["with_matches"]) == (alone["photometric"], alone["with_matches"])
    assert (found["photometric"]["right"], found["photometric"]["wrong"]) == (18, 14)
    model = gate_fit.fit_model(both, SHIPPED_MODEL, {"seed": 4})
    assert model.fitted_on == {"seed": 4, "poses": 32, "right": 18, "doubted": 0}


# ------------------------------------------------------------------ a fleet


class Planted:
    """What is drawn: scenes, the gaps between arrivals, the times of jobs, and when which replica dies."""

    def __init__(self, scenes: list[int], gaps: list[float], times: list[float], deaths: list[float]) -> None:
        self._scenes, self._gaps, self._times, self._deaths = scenes, gaps, times, iter(deaths)
        self.asked: list[Any] = []

    def choice(self, count: int, size: int, p: np.ndarray) -> np.ndarray:
        self.asked.append(p.tolist())
        return np.array(self._scenes)

    def exponential(self, mean: float, size: int | None = None) -> Any:
        self.asked.append(mean)
        if size is None:
            return next(self._deaths)
        return np.array(self._gaps if len(self.asked) == 2 else self._times)

    def integers(self, count: int) -> int:
        return count - 1


def simulated(model: FleetModel, monkeypatch: pytest.MonkeyPatch, *drawn: Any) -> tuple[Any, list[Any]]:
    rng = Planted(*drawn)
    monkeypatch.setattr(fleet_simulation.np.random, "default_rng", lambda seed: rng)
    return FleetSimulation(model).run(), rng.asked


def test_a_fleet_by_hand_without_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    """One replica with room for one of two scenes; the fifth part of the jobs, here the first one, isn't counted."""
    model = FleetModel(1, 2, jobs=5, utilization=0.5, zipf=2.0, scenes_in_memory=1, service_s=1.0, load_s=4.0)
    # Arrivals at 1, 2, 4, 5, 20; s0 is in memory, s1 is loaded when nothing uses s0 any more.
    found, asked = simulated(
        model, monkeypatch, [0, 0, 0, 1, 1], [1.0, 1.0, 2.0, 1.0, 15.0], [2.0, 0.5, 1.5, 1.0, 0.25], []
    )
    assert asked == [[0.8, pytest.approx(0.2)], 2.0, 1.0]
    # Ends: 3 (2 s after 1), 3.5, 5.5; s1 waits for the end at 5.5, loads until 9.5, and ends at 10.5; then 20.25.
    took = [1.5, 1.5, 5.5, 0.25]
    assert (found.p50_s, found.p95_s, found.p99_s) == pytest.approx(tuple(np.quantile(took, [0.5, 0.95, 0.99])))
    assert found.loads_per_job == 1 / 4
    assert found.found_share == 1.0
    assert found.busy_share == pytest.approx((2.0 + 0.5 + 1.5 + 1.0 + 0.25) / 20.25)
    assert (found.repeated, found.ended) == (0, 5)


def test_placement_expects_of_a_load_what_the_simulation_lets_it_take() -> None:
    assert FleetSimulation(FleetModel(1, 1, load_s=7.0))._table._load_s(fleet_simulation._SIZE) == pytest.approx(7.0)


def test_a_fleet_by_hand_whose_replica_dies(monkeypatch: pytest.MonkeyPatch) -> None:
    """The only replica dies at 2 with a job that runs and one that waits; another one is there at 5 and loads."""
    model = FleetModel(1, 1, jobs=3, service_s=1.0, load_s=4.0, failures_per_hour=7.0, restart_s=3.0)
    found, asked = simulated(model, monkeypatch, [0, 0, 0], [0.5, 1.0, 2.0], [2.0, 1.0, 0.5], [2.0, 1000.0])
    # Loaded at 9; the jobs of 0.5, 1.5 and 3.5 end at 11, 12 and 12.5, and all three count.
    assert (found.p50_s, found.ended, found.repeated) == (10.5, 3, 2)
    assert found.loads_per_job == pytest.approx(1 / 3)
    assert found.busy_share == pytest.approx(3.5 / 12.5)
    assert asked[-2:] == [pytest.approx(3600 / 7)] * 2


# ------------------------------------------------------------------ modified scenes


def scene_of(count: int, **arrays: Any) -> GaussianScene:
    rng = np.random.default_rng(3)
    given = {
        "means": rng.normal(size=(count, 3)), "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "scales": rng.uniform(0.1, 0.3, (count, 3)), "opacities": rng.uniform(0.4, 0.9, count),
        "sh": rng.normal(size=(count, 4, 3)) / 9,
    }  # fmt: skip
    arrays = {name: np.asarray(value, np.float32) for name, value in (given | arrays).items()}
    return GaussianScene(**arrays, info=SceneInfo("s", "s", "abc", "ply"))


def test_the_largest_component_of_a_rotation_follows_from_the_others() -> None:
    """By hand: of (0.5, -0.7, 0.1, 0.5), whose largest is made positive, the others are rounded to thirds of 0.7071."""
    quats = float32s([[0.5, -0.7, 0.1, 0.5]])
    third = 1 / (3 * np.sqrt(2))
    rest = np.sqrt(1 - 2 * (2 * third) ** 2)
    expected = [[-2 * third, rest, 0.0, -2 * third]]
    assert scene_modifications._three_kept(quats, 3.0) == pytest.approx(float32s(expected), abs=1e-6)


def test_codes_are_means_of_what_they_stand_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_modifications, "CODES", 3)
    values = float32s([[0.0, 1.0], [10.0, 12.0], [31.0, 11.0], [30.0, 2.0]])
    expected = [[1.0, 1.0], [11.0, 11.0], [30.5, 11.0], [30.5, 1.0]]
    assert scene_modifications._coded(values).tolist() == expected


def test_spz_and_splat_round_as_their_formats_do() -> None:
    sh = np.full((1, 9, 3), 0.3)
    sh[0, 0], sh[0, 1], sh[0, 4] = [1.0, -9.0, 0.2], [2.0, -0.3, 0.3], [-2.0, 0.3, 0.1]
    scene = scene_of(
        1, sh=sh, means=[[0.1, 2.3, -4.5]], scales=[[0.01, 1e-9, 1e9]], opacities=[0.31], quats=[[0.6, -0.8, 0, 0]]
    )
    spz = scene_modifications._spz(scene, 1.0, None, None)  # type: ignore[arg-type]
    # A step of the first colours is 1 / (0.15 * 255), of the second ones a 16th, of the third ones an 8th.
    assert spz.sh[0, 0, [0, 2]] * 38.25 == pytest.approx([38, 8])
    assert round(float(spz.sh[0, 0, 1]) * 38.25) in (-127, -128)  # clipped at -127.5
    assert spz.sh[0, 1].tolist() == [1.0, -5 / 16, 5 / 16]
    assert spz.sh[0, 4].tolist() == [-1.0, 2 / 8, 1 / 8]
    assert spz.means[0].tolist() == [round(v * 4096) / 4096 for v in (0.1, 2.3, -4.5)]
    assert np.log(spz.scales[0]) == pytest.approx(np.array([round(np.log(0.01) * 16) / 16, -10, 6 - 1 / 16]), abs=1e-5)
    splat = scene_modifications._splat(scene, 1.0, None, None)  # type: ignore[arg-type]
    colours = np.rint(np.clip(0.5 + SH_C0 * sh[0, 0], 0, 1) * 255) / 255
    assert splat.sh[0] == pytest.approx((colours[None] - 0.5) / SH_C0, abs=1e-5)
    assert splat.opacities[0] == pytest.approx(79 / 255)
    assert splat.quats[0] == pytest.approx(np.array([77, -102, 0, 0]) / np.hypot(77, 102))


def test_the_least_important_gaussians_go_first() -> None:
    """Importance is opacity times the two larger scales."""
    scales = [[9.0, 0.1, 0.2], [1.0, 2.0, 1.0], [0.5, 3.0, 0.1], [1.0, 1.5, 1.2], [0.1, 0.1, 0.1]]
    opacities = [0.9, 0.7, 0.8, 0.91, 0.99]  # 1.62, 1.4, 1.2, 1.638 (by 1.5 * 1.2), 0.0099
    scene = scene_of(5, scales=scales, opacities=opacities)
    thin = scene_modifications._thin(scene, 0.6, None, None)  # type: ignore[arg-type]
    assert thin.opacities.tolist() == pytest.approx([0.9, 0.91])


def test_floaters_have_their_sizes_and_are_among_what_is_seen() -> None:
    scene = scene_of(40, means=np.random.default_rng(0).uniform([2, 5, -8], [4, 9, -6], (40, 3)))
    found = scene_modifications._floaters(scene, 0.1, Units(np.zeros(3), 0.25, False), np.random.default_rng(1))
    assert found.count == 40 + 300 + 30
    low, high = np.quantile(scene.means, [0.25, 0.75], axis=0)
    added = found.means[40:]
    assert (added >= low - 1e-5).all()
    assert (added <= high + 1e-5).all()
    faint, opaque = found.scales[40:340] / 4, found.scales[340:] / 4
    assert (0.05 <= faint.min() < 0.06, 0.29 < faint.max() <= 0.3) == (True, True)
    assert (0.0099 <= opaque.min() < 0.013, 0.037 < opaque.max() <= 0.0401) == (True, True)
    assert np.linalg.norm(found.quats[40:], axis=1) == pytest.approx(np.ones(330), abs=1e-6)


# ------------------------------------------------------------------ large scenes


def test_cells_lie_around_the_middle_ring_by_ring() -> None:
    cells = list(islice(large_scenes._cells_by_ring(), 8 + 16 + 24))
    for ring, (first, last) in enumerate(((0, 8), (8, 24), (24, 48)), 1):
        assert {max(abs(x), abs(y)) for x, y in cells[first:last]} == {ring}
        assert len(set(cells[first:last])) == last - first


def test_horizontal_is_what_is_farthest_from_up() -> None:
    axes = large_scenes._horizontal_axes(np.array([0.1, -0.9, 0.3]))
    assert [axis.tolist() for axis in axes] == [[1, 0, 0], [0, 0, 1]]


def test_a_copy_has_other_colours_by_a_gain_of_each_channel() -> None:
    """The colour that is seen, 0.5 + the sum of the harmonics, is multiplied."""
    sh = np.random.default_rng(2).normal(size=(3, 4, 3)).astype(np.float32)
    gains, order = float32s([0.7, 1.1, 1.3]), np.array([2, 0, 1])
    rng: Any = SimpleNamespace(uniform=lambda low, high, count: np.array([0.7, 1.1, 1.3]), permutation=lambda n: order)
    nothing = np.zeros((3, 3), np.float32)
    raw = RawGaussians(nothing, np.zeros((3, 4), np.float32), nothing, np.zeros(3, np.float32), sh)
    basis = np.array([SH_C0, 0.3, -0.2, 0.6])
    seen, expected = (0.5 + np.einsum("k,nkc->nc", basis, s) for s in (large_scenes._recolour(raw, rng).sh, sh))
    assert seen == pytest.approx(expected[:, order] * gains, abs=1e-5)


def test_a_cut_keeps_the_first_gaussians_along_x() -> None:
    means = float32s([[3, 0, 9], [1, 5, 2], [2, -7, 1], [-4, 8, 0]])
    raw = RawGaussians(
        means, np.zeros((4, 4), np.float32), means, float32s([0.1, 0.2, 0.3, 0.4]), np.zeros((4, 1, 3), np.float32)
    )
    assert large_scenes._cut(raw, 2).opacities == pytest.approx([0.4, 0.2])


# ------------------------------------------------------------------ photos


def test_a_render_gets_the_photos_exposure() -> None:
    """A photo of 0.4 x + 0.3 of each pixel of the render, but where it isn't valid."""
    render = np.random.default_rng(1).uniform(size=(6, 8, 3)).astype(np.float32)
    photo = float32s([0.4, 0.7, -0.2]) * render + float32s([0.3, 0.1, 0.6])
    valid = np.ones((6, 8), bool)
    valid[2:4, :3], photo[2:4, :3] = False, 9.0
    matched = miss_images._match_exposure(render, photo, valid)
    assert matched[valid] == pytest.approx(photo[valid], abs=1e-5)
    assert matched[2, 1, 0] == pytest.approx(0.4 * render[2, 1, 0] + 0.3, abs=1e-5)


def test_a_crop_of_a_small_photo_is_padded_by_its_reflection() -> None:
    photo = np.arange(2 * 3 * 3, dtype=np.float32).reshape(2, 3, 3)
    asked: list[tuple[int, int]] = []

    def integers(low: int, high: int) -> int:
        asked.append((low, high))
        return high - 1

    rng: Any = SimpleNamespace(integers=integers)
    assert np.array_equal(modifications._random_crop(photo, 3, 2, rng), photo[[0, 1, 1]][:, 1:])
    assert asked == [(0, 1), (0, 2)]
    # The place is anywhere where the crop fits, to the last pixel.
    large = np.arange(7 * 9 * 3, dtype=np.float32).reshape(7, 9, 3)
    assert np.array_equal(modifications._random_crop(large, 3, 2, rng), large[4:7, 7:9])
    assert asked[2:] == [(0, 5), (0, 8)]


def test_cutting_and_resizing_take_the_mask_along() -> None:
    lens = Intrinsics(8, 6, 20.0, 22.0, 4.5, 2.5)
    mask = np.ones((6, 8), bool)
    mask[3, 5] = False
    whole = Photo(np.zeros((6, 8, 3), np.float32), lens, poses()[0], mask=mask)
    assert whole.focal_of_whole == 2.5
    part = whole.cut(2, 1, 5, 4)
    assert (part.intrinsics.cx, part.intrinsics.cy, part.focal_of_whole) == (2.5, 1.5, 2.5)
    assert part.mask is not None
    assert np.argwhere(~part.mask).tolist() == [[2, 3]]
    small = whole.resized(4, 3)
    assert small.mask is not None
    assert np.argwhere(~small.mask).tolist() == [[1, 2]]  # one of the four pixels in its place
    assert small.pixels().shape == (3, 4, 4)


@pytest.mark.parametrize(("photos", "read"), [(20, range(20)), (21, range(0, 21, 2)), (43, range(0, 43, 3))])
def test_at_most_twenty_occluders_are_read_evenly_spread(photos: int, read: range, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    for k in range(photos):
        Image.new("L", (64, 48), 5 * k).save(tmp_path / "deep" / f"{k:02}.png")
    (tmp_path / "notes.txt").write_text("no photo")
    assert [round(float(rgb.mean()) * 255) for rgb in bench.read_occluders(tmp_path)] == [5 * k for k in read]
    with pytest.raises(SceneNotFound, match="no photos"):
        bench.read_occluders(tmp_path / "none")


def test_trials_are_spread_evenly_over_the_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = SimpleNamespace(data=b"", intrinsics=LENS, truth=SimpleNamespace(pose=poses()[0]))
    drawn: list[int] = []
    monkeypatch.setattr(bench, "prepare_photo", lambda *asked: sent)
    monkeypatch.setattr(
        bench, "start_pose", lambda kind, truth, units, training, rng: drawn.append(int(rng.integers(1 << 40)))
    )
    one: Any = SimpleNamespace(
        photos=[SimpleNamespace(name=n) for n in "abc"], background_rgb=(0, 0, 0), units=None, training=()
    )
    trials = [(trial.photo, trial.number) for trial in bench.make_trials(one, "easy", 5, 7)]
    assert trials == [("a", 0), ("a", 1), ("b", 0), ("b", 1), ("c", 0)]
    assert [trial.photo for trial in bench.make_trials(one, "easy", 2, 7)] == ["a", "b"]
    # Each by its seed, photo and number alone.
    assert drawn[5:] == [drawn[0], drawn[2]]
    assert len(set(drawn)) == 5


# ------------------------------------------------------------------ files, and what JSON holds


def test_a_pose_in_a_file_is_a_rigid_motion(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = [3, 5, 7]
    file = tmp_path / "a.pose.txt"

    def read(changed: tuple[int, int], by: float) -> np.ndarray:
        other = matrix.copy()
        other[changed] += by
        file.write_text(" ".join(map(str, other.ravel())))
        return read_pose_file(file)[0].pose.world_from_camera

    # The rotation is made exact where it is a hundredth off, and the last row is what it must be.
    assert read((0, 0), 0.009) == pytest.approx(matrix, abs=1e-12)
    assert read((3, 2), 9e-7)[3].tolist() == [0, 0, 0, 1]
    for changed, by, says in (((0, 0), 0.011, "orthogonal"), ((3, 2), 2e-6, "last row"), ((1, 1), -2.0, "right-handed"),
                              ((1, 3), float("inf"), "finite")):  # fmt: skip
        with pytest.raises(InvalidRequest, match=says):
            read(changed, by)


def test_a_name_with_spaces_is_one_and_intrinsics_after_it_are_none_of_it(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("# titles\n\na b.jpg\nc.jpg PINHOLE 64 48 60 33\nd.jpg PINHOLE 64 48 60\n")
    assert read_names(tmp_path / "list.txt") == ["a b.jpg", "c.jpg", "d.jpg PINHOLE 64 48 60"]


@pytest.mark.parametrize(("count", "chosen"), [(1, "a"), (3, "adg"), (7, "abcdefg"), (9, "abcdefg"), (4, "aceg")])
def test_a_few_are_evenly_spread_from_the_first_to_the_last(count: int, chosen: str) -> None:
    assert "".join(every("abcdefg", count)) == chosen


def test_json_has_no_infinity() -> None:
    assert [finite(value) for value in (2.5, float("inf"), float("nan"))] == [2.5, None, None]
