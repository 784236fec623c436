"""The bench of the gate: its fit against planted weights, its counts by hand, its pictures of nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from test_bench import FakeLoaded, FakeMatcher, FakeRasterizer, estimate, folder_of, poses

from service.bench import gate
from service.bench import localize as bench
from service.bench.gate import GARBAGE, unrelated_image
from service.bench.gate_fit import Sample, fit_model, fitted, floors, probabilities, summary
from service.bench.pose_metrics import Units
from service.geometry import moved, pose_distance
from service.pose.verification.gate import VERIFICATION
from service.pose.verification.gate_model import MODEL_FILE, SHIPPED_MODEL, load_model, write_model
from service.results import IterationRecord, Reason, Status, Verdict


def test_the_fit_finds_planted_weights_and_no_negative_ones() -> None:
    rng = np.random.default_rng(0)
    features = np.concatenate([np.ones((20_000, 1)), rng.uniform(size=(20_000, 3))], 1)
    planted = np.array([-2.0, 3.0, 1.0, -2.0])
    right = rng.uniform(size=len(features)) < probabilities(features, planted)
    # Both classes weigh alike: that shifts the bias alone.
    found = fitted(features[:, :3], rng.uniform(size=len(features)) < probabilities(features[:, :3], planted[:3]))
    assert found[1:] == pytest.approx([3.0, 1.0], abs=0.25)
    assert fitted(features, right)[3] == 0


def test_three_of_a_thousand_right_poses_are_below_a_floor() -> None:
    features = np.column_stack([np.arange(10_000.0), -np.arange(10_000.0)])
    assert (features < floors(features)).sum(0).tolist() == [30, 30]


def test_a_sample_on_the_floor_or_at_the_bound_of_the_pixels_passes() -> None:
    """The floor of each fold is that of the others, which are alike."""
    samples = [replace(sample(s, "clean", True, 0.5), photo=s) for s in "abc" for _ in range(5)]
    samples += [sample(s, "moved", False, 0.0) for s in "abc" for _ in range(5)]
    assert summary(samples, SHIPPED_MODEL)["photometric"]["right_localized"] == 15
    lower = [replace(s, signals={n: 0.98 * v for n, v in s.signals.items()}) if s.scene == "a" else s for s in samples]
    assert summary(lower, SHIPPED_MODEL)["photometric"]["right_localized"] == 10


def sample(scene: str, kind: str, right: bool, level: float, doubted: bool = False) -> Sample:
    signals = {
        name: scale.at_zero + level * (scale.at_one - scale.at_zero) for name, scale in SHIPPED_MODEL.scales.items()
    }
    return Sample(scene, kind, "p", right, signals, doubted, None)


def test_counts_are_of_scenes_that_were_left_out() -> None:
    rng = np.random.default_rng(1)
    samples = []
    for scene in ("a", "b", "c"):
        samples += [sample(scene, "clean", True, level) for level in rng.uniform(0.8, 1.0, 60)]
        samples += [sample(scene, "moved", False, level) for level in rng.uniform(0.0, 0.3, 60)]
        samples += [sample(scene, "foreign", False, 0.0) for _ in range(20)]
        samples += [sample(scene, "garbage", False, 1.0, doubted=True)]  # a doubt keeps it from being called localized
    found = summary(samples, SHIPPED_MODEL)["with_matches"]
    assert (found["right"], found["wrong"], found["foreign_or_garbage"]) == (180, 180, 63)
    assert (found["wrong_localized"], found["foreign_or_garbage_localized"]) == (0, 0)
    assert found["right_localized"] > 120
    assert sum(row["count"] for row in found["reliability"]) == len(samples)
    top = found["reliability"][-1]
    assert VERIFICATION.min_localized < top["said"] <= 1
    assert found["by_kind"]["clean"]["right"] == 180


def scene_samples(scene: str, photos: int, rng: np.random.Generator) -> list[Sample]:
    return [
        replace(sample(scene, kind, right, level), photo=str(number))
        for number in range(photos)
        for kind, right, low, high in (("clean", True, 0.8, 1.0), ("moved", False, 0.0, 0.3))
        for level in rng.uniform(low, high, 10)
    ]


def test_the_model_of_a_single_scene_is_tested_on_photos_that_were_left_out(tmp_path: Path) -> None:
    samples = scene_samples("a", 8, np.random.default_rng(2))
    assert summary(samples, SHIPPED_MODEL)["photometric"]["wrong_localized"] == 0
    model = fit_model(samples, SHIPPED_MODEL, {"scenes": [{"name": "a", "sha256": "0", "photos": 8}]})
    assert (model.fitted_on["poses"], model.fitted_on["right"], model.fitted_on["scenes"][0]["photos"]) == (160, 80, 8)
    # The file says the same, and a signal below the floors of right poses is in doubt.
    write_model(model, tmp_path / "model.json")
    read = load_model(tmp_path / "model.json")
    right, wrong = (sample("a", "clean", True, level).signals for level in (0.97, 0.1))
    for signals in (right, wrong):
        assert read.probability(signals) == model.probability(signals)
        assert read.below_floor(signals) == model.below_floor(signals)
    assert read.probability(wrong) < 0.5 < read.probability(right)
    assert read.below_floor(right) == []
    assert set(read.below_floor(wrong)) == set(SHIPPED_MODEL.scales)


def test_floors_set_by_hand_survive_a_fit(tmp_path: Path) -> None:
    """A level of 0.8 and more would give each signal a floor near 0.8; the shipped one of local colour is higher."""
    samples = scene_samples("a", 4, np.random.default_rng(4))
    model = fit_model(samples, SHIPPED_MODEL, {})
    by_hand, fitted_freely = "local_colour_correlation", "colours"
    assert model.floors[by_hand] == SHIPPED_MODEL.floors[by_hand] == 0.935
    assert model.floors[fitted_freely] != SHIPPED_MODEL.floors[fitted_freely]
    # Without the mark the fit determines this floor, too.
    unmarked = fit_model(samples, replace(SHIPPED_MODEL, set_by_hand={}), {})
    assert unmarked.floors[by_hand] < 0.92
    # The file keeps the mark, and so does a fit from it.
    write_model(model, tmp_path / "model.json")
    read = load_model(tmp_path / "model.json")
    assert fit_model(samples, read, {}).floors == read.floors == model.floors
    assert "mistake a thing for a similar one" in read.set_by_hand[by_hand].reason


def test_colours_count_unless_matches_and_gradients_support_another_light(tmp_path: Path) -> None:
    right = sample("a", "clean", True, 0.97).signals
    in_other_light = {**right, "colours": 0.1, "colours_half": 0.2, "local_colour_correlation": 0.4}
    colours = ["colours", "colours_half", "local_colour_correlation"]
    assert SHIPPED_MODEL.below_floor(in_other_light) == colours
    assert SHIPPED_MODEL.below_floor(in_other_light, light_may_differ=True) == []
    for name, value in {"inliers": 80.0, "inlier_share": 0.55, "inlier_spread": 0.45, "gradients_half": 0.88}.items():
        weaker = {**in_other_light, name: value}
        assert set(SHIPPED_MODEL.below_floor(weaker, light_may_differ=True)) >= set(colours)
    # Other doubts remain, and without matches there is no support.
    assert SHIPPED_MODEL.below_floor({**in_other_light, "drift_px": 15.0}, light_may_differ=True) == ["drift_px"]
    alone = {name: value for name, value in in_other_light.items() if not name.startswith("inlier")}
    assert SHIPPED_MODEL.below_floor(alone, light_may_differ=True) == colours
    # A fit keeps the rule, and so does its file.
    write_model(fit_model(scene_samples("a", 4, np.random.default_rng(4)), SHIPPED_MODEL, {}), tmp_path / "m.json")
    read, ours = load_model(tmp_path / "m.json"), SHIPPED_MODEL
    assert (read.other_light, read.less_detail) == (ours.other_light, ours.less_detail)
    assert read.poor_model == ours.poor_model


def test_less_support_is_enough_for_colours_that_are_nearly_right() -> None:
    right = sample("a", "clean", True, 0.97).signals
    support = {"inliers": 210.0, "inlier_share": 0.56, "inlier_spread": 0.7, "gradients_half": 0.87}
    nearly = {**right, **support, "colours_half": 0.92, "local_colour_correlation": 0.82}
    assert SHIPPED_MODEL.below_floor(nearly) == ["local_colour_correlation"]
    assert SHIPPED_MODEL.below_floor(nearly, light_may_differ=True) == []
    less = {"inliers": 190.0, "inlier_share": 0.54, "inlier_spread": 0.55, "gradients_half": 0.84}
    for name, value in (less | {"colours_half": 0.88, "local_colour_correlation": 0.78}).items():
        assert "local_colour_correlation" in SHIPPED_MODEL.below_floor({**nearly, name: value}, light_may_differ=True)


def test_gradients_count_unless_matches_and_colours_support_the_pose() -> None:
    """An enlarged crop is blurred: its gradients hardly correlate, all else agrees."""
    right = sample("a", "clean", True, 0.97).signals
    blurred = {**right, "gradients": 0.5, "gradients_half": 0.75, "inliers": 400.0}
    assert SHIPPED_MODEL.below_floor(blurred) == []
    gradients = {"gradients", "gradients_half"}
    weaker = {"inliers": 150.0, "inlier_share": 0.6, "inlier_spread": 0.5, "colours_half": 0.9}
    for name, value in {**weaker, "local_colour_correlation": 0.95}.items():
        assert gradients <= set(SHIPPED_MODEL.below_floor({**blurred, name: value}))
    alone = {name: value for name, value in blurred.items() if not name.startswith("inlier")}
    assert set(SHIPPED_MODEL.below_floor(alone)) == gradients


def test_a_photo_that_always_fails_moves_only_its_own_fold() -> None:
    """Were the test on the samples of the fit, the odd photo's right poses would lower the floors and pass."""
    rng = np.random.default_rng(3)
    samples = scene_samples("a", 8, rng)
    odd = [replace(sample("a", "clean", True, 0.6), photo="0") for _ in range(4)]
    found = summary(samples + odd, SHIPPED_MODEL)["with_matches"]
    assert found["right"] - found["right_localized"] >= len(odd)


def test_a_model_of_another_version_is_refused(tmp_path: Path) -> None:
    content = json.loads(MODEL_FILE.read_text())
    (tmp_path / "model.json").write_text(json.dumps(content | {"version": 99}))
    with pytest.raises(ValueError, match="version 99"):
        load_model(tmp_path / "model.json")


def test_pictures_of_nothing_are_pictures_and_differ() -> None:
    pictures = [unrelated_image(number) for number in range(GARBAGE)]
    assert all(p.shape == (480, 640, 3) and p.dtype == np.float32 for p in pictures)
    assert all(p.min() >= 0 and p.max() <= 1 for p in pictures)
    means = np.array([[p.mean(), p.std(), np.abs(np.diff(p, axis=1)).mean()] for p in pictures])
    assert len(np.unique(means.round(4), axis=0)) == GARBAGE


def test_pictures_of_nothing_are_what_they_are_called() -> None:
    grey, noise, ramp, blotches, diagonal, bars, rectangles, soft = map(unrelated_image, range(GARBAGE))
    assert np.unique(grey) == 0.5
    assert np.ptp(ramp, axis=0).max() == 0
    assert (ramp[0, 0] == 0).all()
    assert (ramp[0, -1] == 1).all()
    # Diagonal stripes of 20 pixels; bars of 4 or a multiple.
    assert set(np.unique(diagonal)) == set(np.unique(bars)) == {0.0, 1.0}
    assert (diagonal[0, :80, 0] == np.repeat([0, 1, 0, 1], 20)).all()
    assert np.array_equal(diagonal[1:, :-1], diagonal[:-1, 1:])
    assert np.ptp(bars[0, :, 0].reshape(-1, 4), axis=1).max() == np.ptp(bars, axis=0).max() == 0
    # How far neighbours differ: noise by 1/3 on average; what was enlarged 4 and 40 times by about 4 and 40 times less.
    roughness = [np.abs(np.diff(picture, axis=1)).mean() for picture in (noise, soft, blotches)]
    assert roughness[0] == pytest.approx(1 / 3, rel=0.02)
    assert roughness[0] > 3 * roughness[1] > 15 * roughness[2] > 0
    # Nearly everything but the margins is covered by rectangles of random colours.
    assert (rectangles == 0.5).all(2).mean() < 0.05
    assert 40 < len(np.unique(rectangles.reshape(-1, 3), axis=0)) <= 201


# ------------------------------------------------------------------ how samples are gathered


def bench_scene(units_per_scene_unit: float = 1.0) -> SimpleNamespace:
    loaded = SimpleNamespace(scene=SimpleNamespace(info=SimpleNamespace(name="s")))
    return SimpleNamespace(units=Units(np.zeros(3), units_per_scene_unit, False), loaded=loaded)


def test_poses_are_moved_by_the_stated_distances_evenly_on_a_logarithmic_scale() -> None:
    rng = np.random.default_rng(0)
    for between, most_deg in (gate.MOVED, gate.NEAR):
        away = [
            pose_distance(gate._moved(poses()[0], bench_scene(2.0), between, most_deg, rng), poses()[0])
            for _ in range(200)
        ]
        degrees, scene_units = np.array(away).T
        low, high = np.array(between) / 2.0
        assert low <= scene_units.min() < 1.1 * low
        assert 0.9 * high < scene_units.max() <= high
        assert np.median(scene_units) == pytest.approx(np.sqrt(low * high), rel=0.25)
        assert 0.95 * most_deg < degrees.max() <= most_deg
        assert np.median(degrees) == pytest.approx(most_deg / 2, rel=0.15)
    # As the module describes them.
    assert gate.MOVED == ((0.06, 1.5), 8.0)
    assert gate.NEAR == ((0.002, 0.012), 0.12)


@pytest.mark.parametrize(
    ("degrees", "units", "right"), [(4.9, 0.0, True), (5.1, 0.0, False), (0.0, 0.049, True), (0.0, 0.051, False)]
)
def test_a_pose_is_right_within_five_degrees_and_a_twentieth(degrees: float, units: float, right: bool) -> None:
    truth, verdict = poses()[0], estimate(poses()[0]).verdict
    pose = moved(truth, np.array([0, 0, np.radians(degrees), units / 2, 0, 0]))
    assert gate._sample(bench_scene(2.0), "clean", "p", truth, pose, verdict).right is right
    assert not gate._sample(bench_scene(2.0), "foreign", "p", None, pose, verdict).right


@pytest.mark.parametrize(
    ("reason", "doubted"),
    [
        *((Reason(name), True) for name in ("focal_uncertain", "intrinsics_contradicted", "low_coverage")),
        *((Reason(name), True) for name in ("position_uncertain", "ambiguous", "mirrored")),
        *((Reason(name), False) for name in ("verified", "render_mismatch", "few_inliers")),
    ],
)
def test_what_has_a_reason_beside_the_signals_is_in_doubt(reason: Reason, doubted: bool) -> None:
    verdict = replace(estimate(poses()[0]).verdict, reason=reason)
    assert gate._sample(bench_scene(), "clean", "p", None, poses()[0], verdict).doubted is doubted


def large_photos(folder: Path) -> Path:
    """Enlarge a scene's photos, so that enough is left where they are cropped."""
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for frame in data["frames"]:
        frame |= {name: 6 * frame[name] for name in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        with Image.open(folder / frame["file_path"]) as image:
            image.resize((384, 288)).save(folder / frame["file_path"])
    file.write_text(json.dumps(data))
    return folder


@pytest.fixture
def gathered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`gate.run` on scenes of two photos whose every photo is localized where the first one was taken."""
    truths = [poses()[0], poses()[5]]
    seen = SimpleNamespace(occluders=set(), queries=0, progress=[])

    def verdict_at(pose, status=Status.LOCALIZED) -> Verdict:
        degrees, distance = np.min([pose_distance(pose, truth) for truth in truths], axis=0)
        level = 0.95 if degrees < 5 and distance < 0.03 else 0.1
        return replace(estimate(pose, status).verdict, signals=dict(sample("s", "", True, level).signals))

    def localize(query, loaded, request):
        assert request.options.effort == "fast"
        seen.queries += 1
        inliers = 1000 if query.rgb.shape[1] == 384 else 3
        record = IterationRecord("refine", poses()[0], num_inliers=inliers)
        return replace(estimate(poses()[0]), records=(record,))

    def prepare_photo(photo, modify, background, seed, occluders):
        seen.occluders |= {picture.shape for picture in occluders}
        return original(photo, modify, background, seed, occluders)

    original = gate.prepare_photo
    monkeypatch.setattr(gate, "prepare_photo", prepare_photo)
    monkeypatch.setattr(bench.LoadedScene, "of", lambda scene, **_: FakeLoaded(scene, FakeRasterizer(), FakeMatcher()))
    monkeypatch.setattr(gate, "localize", localize)
    monkeypatch.setattr(gate, "render_and_verify", lambda images, pose, rasterizer: verdict_at(pose))
    monkeypatch.setattr(gate, "verify", lambda images, pose, rendered: verdict_at(pose))
    # A step of refinement leads nowhere: once to no pose at all, else back to the truth or to where it began.
    losses = iter([np.inf] + [1.0] * 1000)
    monkeypatch.setattr(
        gate, "refine_photometric", lambda p, f, c, start, levels: SimpleNamespace(loss=next(losses), pose=start.pose)
    )
    found = iter([None, *(SimpleNamespace(pose=pose) for pose in truths * 1000)])
    monkeypatch.setattr(gate, "refine_from", lambda images, expected, rendered, rasterizer: next(found))
    verdicts = iter([None, *([Status.LOCALIZED, Status.NOT_LOCALIZED] * 1000)])
    monkeypatch.setattr(gate, "verify_tracked", lambda images, f: (s := next(verdicts)) and verdict_at(f.pose, s))

    def run(*names: str) -> tuple[dict, SimpleNamespace]:
        folders = [large_photos(folder_of(tmp_path / name, "nerfstudio")) for name in names]
        return gate.run(folders, progress=lambda *now: seen.progress.append(now)), seen

    return run


def test_the_samples_of_a_scene_are_those_that_the_module_describes(gathered) -> None:
    result, seen = gathered("a")
    by_kind: dict[str, list[dict]] = {}
    for line in result["samples"]:
        by_kind.setdefault(line["kind"], []).append(line)
    counts = {kind: len(lines) for kind, lines in by_kind.items()}
    drawn = {name if name else "clean" for name in (",".join(m) for m in gate.WITHIN_REASON)}
    drawn |= {f"beyond {m[0]}" for m in gate.BEYOND}
    # Of two photos: each modification once, the mirror image, six poses moved little and much.
    assert counts == dict.fromkeys([*drawn, "mirrored"], 2) | {
        "near": 12, "moved": 12, "drifted": 11, "tracked": 11, "garbage": GARBAGE
    }  # fmt: skip
    assert seen.progress == [(1, 2), (2, 2)]
    assert seen.queries == 2 * (len(drawn) + 1) + GARBAGE
    # Everything is localized where the first photo was taken; turned by 45 degrees, that is wrong.
    for kind, lines in by_kind.items():
        if kind in drawn:
            assert [line["right"] for line in lines] == [kind != "roll=45", False], kind
    assert all(line["right"] for line in by_kind["near"])
    assert not any(line["right"] for kind in ("mirrored", "garbage", "moved", "drifted") for line in by_kind[kind])
    # The first refinement found nothing; of the other poses the tracker doubts one, then accepts every other.
    assert [line["tracked"] for line in by_kind["tracked"]] == [False, *([True, False] * 5)]
    assert all(line["tracked"] is None for kind, lines in by_kind.items() if kind != "tracked" for line in lines)
    # Many inliers led to the photos' poses, few to those of pictures of another size.
    assert all(line["matched"] for line in by_kind["clean"])
    assert not any(line["matched"] for line in by_kind["garbage"])
    # A single scene has no other photos to cut from.
    assert seen.occluders == {(480, 640, 3)}
    assert result["model"]["fitted_on"]["scenes"][0]["photos"] == 2
    assert result["model"]["fitted_on"]["poses"] == len(result["samples"]) - len(by_kind["tracked"])


def test_photos_of_the_other_scenes_are_foreign_and_cut_from(gathered, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "WITHIN_REASON", ((), ("occlusion=0.2",)))
    monkeypatch.setattr(gate, "BEYOND", ())
    result, seen = gathered("a", "b")
    foreign = [line for line in result["samples"] if line["kind"] == "foreign"]
    assert [(line["scene"], line["right"]) for line in foreign] == [("a", False)] * 2 + [("b", False)] * 2
    assert seen.occluders == {(288, 384, 3)}
    assert seen.progress[-1] == (4, 4)
    # A scene's samples don't depend on the scenes before it: the same photos, the same draws.
    moved_poses = [line["signals"] for line in result["samples"] if line["kind"] == "near"]
    assert moved_poses[:12] == moved_poses[12:]
