"""Numbers that documents state are those of the program: seen in what it does, just inside and just outside of them."""

from __future__ import annotations

import io
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np
import pytest
from api_server import ROOT
from PIL import Image
from test_bench import poses

from service.accuracy import DEFAULT_ACCURACY
from service.bench.bench_photos import BenchPhoto
from service.bench.datasets import LAYOUTS, MIN_LONG_SIDE_PX
from service.bench.evaluate import BOUNDS
from service.bench.field_queries import FieldQuery, decoded, send
from service.bench.field_random import random_row
from service.bench.field_rows import FOCAL_FACTORS, K1, TOLD, Row
from service.bench.fleet_simulation import FLEETS
from service.bench.gpu import LIMIT_S, PARTS
from service.bench.gpu_shared import FULL
from service.bench.live import LINK
from service.bench.live_film import FILM
from service.bench.live_odometry import ODOMETRY
from service.bench.modifications import MODIFICATIONS, require_modifications
from service.bench.paper.plan import MAIN, cells
from service.bench.peer.comparison import MIN_INLIERS
from service.bench.peer.photo_matching import MATCHING as PEER_MATCHING
from service.bench.pose_metrics import Units
from service.bench.scene_modifications import FAINT, OPAQUE, SCENE_MODIFICATIONS, require_scene_modifications
from service.bench.start_poses import start_pose
from service.bench.street import STREET
from service.cli.server import _CONNECTIONS_S
from service.coverage.calibration import MIN_PHOTOS
from service.coverage.measurement import COVERAGE
from service.coverage.plan import PLAN
from service.errors import InvalidOptions
from service.estimators.search_config import SEARCH
from service.estimators.shutter_check import ShutterCheckConfig
from service.geometry import pose_distance
from service.jobs.config import JobsConfig
from service.jobs.service import _RENEWALS
from service.jobs.worker import _BATCH_S
from service.live.fusion import FUSION
from service.live.live_tracker import LIVE
from service.live.pace import GOOD_PX, MAX_USEFUL_PX
from service.live.recent_views import MOST as MOST_VIEWS
from service.photos.decode_config import DEFAULTS
from service.pose.absolute_pose.device_priors import DEVICE_PRIORS
from service.pose.refinement.refinement_config import REFINEMENT
from service.pose.retrieval.floaters import FLOATERS
from service.pose.retrieval.free_views import FREE_VIEWS
from service.pose.retrieval.index_builder import PARTS as WHOLE
from service.pose.retrieval.inverted_views import INVERTED
from service.pose.retrieval.viewpoints import VIEWPOINTS
from service.pose.training_photos.corners import CORNERS
from service.pose.training_photos.digest import DIGEST
from service.pose.training_photos.patch_matching import PATCHES
from service.pose.training_photos.patch_pose import PATCH_POSE
from service.pose.training_photos.surface_points import TRIANGULATION
from service.pose.verification.captured_volume import CAPTURE
from service.pose.verification.gate import VERIFICATION
from service.pose.verification.mirror_images import MIRROR
from service.readings_in_scene import ANCHOR_HEADING_SIGMA, ANCHOR_SIGMA_M
from service.registration.gathering import SCENE_UP_SIGMA
from service.registration.quantiles import chi_square_quantile
from service.scene_manager.camera_frame import CAMERA_FRAME_CONFIG
from service.smoothing import SMOOTHING
from service.types import LENS_PRIORS, Camera, Intrinsics, LensPrior
from service.web.hints import EXAMPLES
from service.web.metrics import _MOST_VALUES
from service.web.routes.live import _BURST_S, _HELLO_S
from service.web.schemas.shared import ShareIn
from service.web.settings import Settings
from service.web.shared_state import RENEW_S
from viewer.scene_cache import MAX_SPLATS

LENS = Intrinsics(240, 180, 200.0, 204.0, 124.0, 86.0)


def rows_of(document: str, header: str) -> Iterator[list[str]]:
    """Yield the cells of a document's table whose header begins like this."""
    text = (ROOT / "docs" / document).read_text("utf-8")
    _, _, table = text.partition(f"\n| {header}")
    for line in table.split("\n\n")[0].splitlines()[2:]:
        yield [cell.strip() for cell in line.strip("|").split(" | ")]


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


# ------------------------------------------------------------------ modifications of the benches

DRAWN = {row[0].strip("` "): (numbers(row[1]), numbers(row[2])) for row in rows_of("benchmarks.md", "`--modify` |")}
RANDOM_K1 = DRAWN["k1"][1]
SCENE_RANGES = {row[0].strip("` "): numbers(row[1]) for row in rows_of("benchmarks.md", "`--modify-scene` |")}


@pytest.mark.parametrize(
    ("require", "name", "low", "high"),
    [(require_modifications, name, ends[0], ends[-1]) for name, (ends, _) in DRAWN.items()]
    + [(require_scene_modifications, name, ends[0], ends[-1]) for name, ends in SCENE_RANGES.items()],
)
def test_values_are_taken_up_to_the_documented_ends(require, name: str, low: float, high: float) -> None:
    require([f"{name}={low}", f"{name}={high}"])
    for beyond in (low - 1e-3, high + 1e-3):
        with pytest.raises(InvalidOptions, match=f"'{name}' takes {low:g} to {high:g}"):
            require([f"{name}={beyond}"])


def test_every_modification_is_documented() -> None:
    assert set(DRAWN) == set(MODIFICATIONS)
    assert set(SCENE_RANGES) == set(SCENE_MODIFICATIONS)


@pytest.fixture(scope="module")
def random_rows() -> list[Row]:
    rng = np.random.default_rng(5)
    return [random_row(rng, LENS) for _ in range(4000)]


def test_random_values_fill_their_documented_ranges(random_rows: list[Row]) -> None:
    seen: dict[str, list[float]] = {}
    for row in random_rows:
        for spec in row.modify:
            name, _, value = spec.partition("=")
            seen.setdefault(name, []).append(float(value))
    assert set(seen) == {name for name, (_, drawn) in DRAWN.items() if drawn}
    for name, values in seen.items():
        drawn = DRAWN[name][1]
        low, high = min(drawn), max(drawn)
        reach = 0.05 * (high - low)  # of 300 values or more
        assert low <= min(values) <= low + reach, name
        assert high - reach <= max(values) <= high, name


def test_random_combinations_are_as_frequent_as_documented(random_rows: list[Row]) -> None:
    shares: dict[str, dict[str, float]] = {}
    for what, text in rows_of("results/field.md", "how often |"):
        shares[what] = {name: float(share) / 100 for name, share in re.findall(r"`(\w+)` (\d+) %", text)}
        shares[what][""] = numbers(text)[0] / 100
    names = [[spec.partition("=")[0] for spec in row.modify] for row in random_rows]
    bent, cut = ["k1", "fisheye", "shutter_yaw", "shutter_pitch"], ["crop", "off_centre", "zoom"]
    pixels = [name for name in MODIFICATIONS if name not in (*bent, *cut, "roll", "focal")]
    lenses = [next((name for name in row if name in bent), None) for row in names]
    defects = Counter(sum(name in pixels for name in row) for row in names)
    told = Counter(row.told for row in random_rows)
    pairs = [(lenses.count(None), shares["lens"][""])]
    pairs += [(lenses.count(name), (1 - shares["lens"][""]) * shares["lens"][name]) for name in bent]
    pairs += [(sum(name in row for row in names), shares["cut"][name]) for name in cut]
    pairs += [(defects[count], share) for count, share in enumerate((0.2, 0.4, 0.3, 0.1))]
    pairs += [(sum("roll" in row for row in names), shares["rolled"][""])]
    pairs += [(sum(bool(row.modify_scene) for row in random_rows), shares["another scene"][""])]
    with_told = sum(row.told != "withheld" for row in random_rows)
    pairs += [(sum("focal" in row for row in names) * len(names) / with_told, shares["a wrong focal length"][""])]
    # Where nothing is distorted, `pinhole` is `told`.
    moved = shares["told"]["pinhole"] * shares["lens"][""]
    expected = shares["told"] | {"told": shares["told"]["told"] + moved, "pinhole": shares["told"]["pinhole"] - moved}
    pairs += [(told[name], expected[name]) for name in TOLD]
    for count, share in pairs:
        # Five standard deviations of a binomial distribution.
        assert abs(count / len(names) - share) < 5 * np.sqrt(share * (1 - share) / len(names)), (count, share)


def test_rows_of_a_lens_go_to_both_ends_of_the_documented_range_in_pairs() -> None:
    assert [min(K1), max(K1)] == RANDOM_K1
    assert sorted(K1) == list(K1) == sorted(-k for k in K1)
    assert sorted(set(FOCAL_FACTORS)) == list(FOCAL_FACTORS)
    assert 0.85 < min(FOCAL_FACTORS) < 1 < max(FOCAL_FACTORS) < 1.15


def test_starts_fill_their_documented_ranges() -> None:
    units = Units(np.zeros(3), 1.0, forward_facing=False)
    cameras, rng = [Camera(LENS, pose) for pose in poses()], np.random.default_rng(0)
    text = {row[0]: row[1] for row in rows_of("benchmarks.md", "start | offset")}
    angles = [pose_distance(start_pose("inplace", poses()[1], units, cameras, rng), poses()[1])[0] for _ in range(80)]
    low, high = numbers(text["`inplace`"])
    assert low <= min(angles) < low + 1.5
    assert high - 1.5 < max(angles) <= high
    _, length = numbers(text["`pnerf`"])
    shifts = [
        np.abs(start_pose("pnerf", poses()[1], units, cameras, rng).position_in_world - poses()[1].position_in_world)
        for _ in range(80)
    ]
    assert 0.95 * length < np.max(shifts) <= length
    for kind, (first, last) in {"near": (0.0, 0.05), "easy": (0.0, 0.5), "hard": (0.5, 1.0)}.items():
        # A camera at the focus: rotations move nothing.
        at_focus = replace(units, focus_in_world=poses()[1].position_in_world)
        moved = [
            np.abs(start_pose(kind, poses()[1], at_focus, cameras, rng).position_in_world - at_focus.focus_in_world)
            for _ in range(80)
        ]
        reach = 0.05 * (last - first)
        assert first <= np.min(moved) < first + reach, kind
        assert last - reach < np.max(moved) <= last, kind


def test_field_photos_are_jpegs_of_the_documented_quality_and_size(tmp_path) -> None:
    (line,) = [
        line for line in (ROOT / "docs/results/field.md").read_text().splitlines() if line.startswith("| told | what")
    ]
    quality, size = numbers(line)
    lens = Intrinsics(1600, 1200, 1400.0, 1400.0, 800.0, 600.0)
    Image.new("RGB", (1600, 1200), "tan").save(tmp_path / "a.jpg")
    one = BenchPhoto("a.jpg", tmp_path / "a.jpg", Camera(lens, poses()[1]))
    sent = Image.open(io.BytesIO(send(decoded(one, (0, 0, 0)), FieldQuery(Row("r", "told"), one), 0).data))
    assert max(sent.size) == size
    buffer = io.BytesIO()
    sent.convert("RGB").save(buffer, "JPEG", quality=int(quality))
    assert sent.quantization == Image.open(buffer).quantization  # type: ignore[attr-defined]


# ------------------------------------------------------------------ published figures


def test_published_figures_are_of_todays_options() -> None:
    """Whoever changes a method's default option, or a study's size, measures again."""
    config = json.loads((ROOT / "docs/results/tables.json").read_text())["config"]
    today = {cell.method.name: cell.method.config() for cell in cells()} | {m.name: m.config() for m in MAIN}
    assert json.loads(json.dumps({name: today[name] for name in config["methods"]})) == config["methods"]


def test_the_gpu_bench_measures_what_its_table_says() -> None:
    said = {row[0]: numbers(row[1]) for row in rows_of("results/gpu.md", "part | what")}
    assert said["pictures"] == [FULL.views, *FULL.widths]
    assert said["poses"] == [FULL.photos, FULL.degraded]
    assert said["throughput"] == list(FULL.at_a_time)
    assert said["sizes"] == [min(FULL.sizes) / 1e6, max(FULL.sizes) / 1e6]
    assert FULL.sizes[2:] == tuple(1_000_000 * count for count in (1, 2, 4, 8, 12))
    assert FULL.sizes[:2] == (250_000, 500_000)
    assert said["many jobs"] == [FULL.jobs]
    assert set(said) == {part.name for part in PARTS}
    text = (ROOT / "docs/results/gpu.md").read_text()
    minutes = int(re.findall(r"less than (\d+) minutes", text)[0])
    assert 60 * (minutes - 0.5) < LIMIT_S < 60 * minutes
    # No part alone can use up the run.
    assert all(30 <= part.limit_s <= LIMIT_S / 3 for part in PARTS)


# ------------------------------------------------------------------ the service


def test_the_simulated_fleets_are_those_of_the_table() -> None:
    found = [(each.replicas, each.scenes, each.failures_per_hour) for each in FLEETS]
    assert found == [
        tuple(float(cell.replace(",", "")) for cell in row[:3]) for row in rows_of("scale.md", "replicas | scenes |")
    ]
    # The text above it; a hundred replicas are simulated for less time, since that takes longer.
    small, *others = FLEETS
    assert (small.scenes_in_memory, {each.scenes_in_memory for each in others}) == (4, {20})
    assert {(each.utilization, each.service_s, each.load_s, each.zipf) for each in FLEETS} == {(0.6, 0.11, 4.0, 1.0)}
    seconds = [each.jobs * each.service_s / each.replicas / each.utilization for each in FLEETS if each.replicas == 100]
    assert {round(each) for each in seconds} == {37}


def test_priors_of_a_lens_are_as_wide_as_the_api_says() -> None:
    table = {(row[0], row[1]): row[2:] for row in rows_of("api.md", "`intrinsics_source` | from")}
    said = {source.strip("` "): row for (source, _), row in table.items() if len(row) > 1}
    given, exif, guessed = LENS_PRIORS["given"], LENS_PRIORS["exif"], LENS_PRIORS["guessed"]
    assert given.log_focal_scale == numbers(said["given"][0])[0] / 100
    assert np.exp(guessed.log_focal_scale) == pytest.approx(numbers(said["guessed"][0])[0], abs=0.05)
    # With what is known of the tag it is narrower (3 to 4 %); without, it allows for crops, too.
    assert max(numbers(said["exif"][0])) / 100 < exif.log_focal_scale < given.log_focal_scale / 2
    for source, prior in (("given", given), ("exif", exif), ("guessed", guessed)):
        assert prior.k1_sigma == numbers(said[source][1])[0]


def test_what_the_jobs_have_by_default_is_what_the_service_sets() -> None:
    ours = asdict(Settings(scenes=[], workers=1).jobs)
    assert ours == asdict(JobsConfig())
    text = (ROOT / "docs/api.md").read_text()
    assert 60 * int(re.findall(r"deleted (\d+) minutes", text)[0]) == ours["photo_grace_s"]


def test_every_layout_is_documented() -> None:
    assert {row[0].strip("` ") for row in rows_of("benchmarks.md", "layout | what")} == set(LAYOUTS)


def sentence(document: str, around: str) -> str:
    """Return the sentence of a document that has these words."""
    text = " ".join((ROOT / document).read_text("utf-8").split())
    (found,) = [part for part in re.split(r"(?<=[a-z)\d])[.:;] ", text) if around in part]
    return found


def test_uploads_are_as_large_as_the_changelog_says() -> None:
    alone, others = numbers(sentence("CHANGELOG.md", "Uploads are limited to"))
    assert Settings(scenes=[], host="127.0.0.1").upload_limit == alone * 1e9
    assert Settings(scenes=[], host="0.0.0.0").upload_limit == others * 1e6
    assert Settings(scenes=[], host="0.0.0.0", max_upload_bytes=7).upload_limit == 7


def test_photos_have_as_many_pixels_as_the_documents_say() -> None:
    webp, other = numbers(sentence("docs/accuracy.md", "WebP photos have at most"))
    assert webp * 1e6 <= DEFAULTS.max_pixels_webp < (webp + 1) * 1e6
    # A phone's 64 megapixels are a few more.
    assert other * 1e6 <= 9248 * 6936 <= DEFAULTS.max_pixels < (other + 4) * 1e6


def test_gaps_are_interpolated_as_the_api_says() -> None:
    (longest,) = numbers(sentence("docs/api.md", "between two that are at most"))[-1:]
    assert longest == SMOOTHING.max_gap_s


def test_a_container_is_given_time_to_end_its_jobs() -> None:
    compose = (ROOT / "docker/compose.yaml").read_text()
    kubernetes = (ROOT / "docker/kubernetes.yaml").read_text()
    given = [int(re.findall(pattern, text)[0]) for pattern, text in (
        (r"stop_grace_period: (\d+)s", compose), (r"terminationGracePeriodSeconds: (\d+)", kubernetes),
    )]  # fmt: skip
    # Open connections first, then the jobs, then what is written last; twice the time for a busy machine.
    assert 2 * (_CONNECTIONS_S + Settings(scenes=[]).shutdown_s) <= min(given)


# ------------------------------------------------------------------ the method


def said(document: str, pattern: str) -> tuple[float, ...]:
    """Return the numbers that stand for each `#` of a pattern in a document; it occurs once, on one line or several."""
    text = " ".join((ROOT / "docs" / document).read_text("utf-8").split())
    (found,) = re.findall(re.escape(pattern).replace(r"\#", r"(\d[\d,]*(?:\.\d+)?)"), text)
    if "#" not in pattern:
        return ()
    return tuple(float(each.replace(",", "")) for each in ([found] if isinstance(found, str) else found))


METHOD = "how-it-works.md"


def test_the_index_and_its_retrieval_are_as_large_as_said() -> None:
    assert said(METHOD, "There are as many as the scene needs, up to #:") == (VIEWPOINTS.max_views,)
    assert said(METHOD, "An index of # views and more is used before it is whole") == (WHOLE.min_views,)
    assert said(METHOD, "first # views are of all over the scene, then their number doubles") == (WHOLE.first_views,)
    assert WHOLE.growth == 2
    assert said(METHOD, "From # views on it is compared only with features") == (INVERTED.min_views,)
    assert said(METHOD, "the scores of the best # views are then computed exactly") == (INVERTED.exact_views,)
    assert said(METHOD, "some # seconds of CPU time with # of them")[1] == FREE_VIEWS.max_views
    assert said(METHOD, "up to six times as many as the index has") == ()
    assert FREE_VIEWS.views_per_index_view == 6


def test_the_gate_accepts_and_doubts_from_the_values_said() -> None:
    assert said(METHOD, "a `right_place` of #;") == (VERIFICATION.min_localized,)
    assert said(METHOD, "the scene in # % of the photo") == (100 * VERIFICATION.min_coverage,)
    assert said(METHOD, "by the covariance a probability of # that") == (VERIFICATION.min_precise,)
    bounds = said(
        METHOD, "turned by more than # degrees, or # times nearer or # times farther, for half of the picture"
    )
    assert bounds == (CAPTURE.max_turn_deg, CAPTURE.max_finer, CAPTURE.max_coarser)
    assert CAPTURE.min_share == 0.5
    test = REFINEMENT.lens_test
    bounds = said(METHOD, "off by more than # degrees, or # % of the distance")
    assert bounds == (test.contradicting_deg, 100 * test.contradicting_share)
    assert said(METHOD, "the position would be uncertain by # % of the distance") == (100 * test.untestable_share,)
    focal, k1, centre = said(METHOD, "the focal length by # %, k1 by #, the principal point by # of the long side")
    assert LensPrior(focal / 100, k1, centre) == test.untested
    assert said(METHOD, "if it leaves # of the residual or less") == (ShutterCheckConfig().max_loss_ratio,)
    assert said(METHOD, "it must fit four times as well") == ()
    assert MIRROR.max_ratio_elsewhere == 1 / 4
    assert said(METHOD, "less alike at each of them, by a tenth or more") == ()
    assert SEARCH.max_rival_ratio == 1 - 1 / 10


def test_training_photos_and_floaters_are_as_said() -> None:
    assert said(METHOD, "Up to # of their patches, spread over the photo") == (PATCH_POSE.max_patches,)
    assert said(METHOD, "within # pixels, by least-squares matching") == (PATCH_POSE.max_motion_px,)
    assert said(METHOD, "rules out points that are more than # % off it") == (100 * TRIANGULATION.max_depth_error,)
    count, side, other = said(
        "scenes.md",
        "up to # surface points of a photo, triangulated over three photos or more, each with a patch of # x #",
    )
    assert (CORNERS.count, PATCHES.side_px, PATCHES.side_px) == (count, side, other)
    assert TRIANGULATION.min_views == 3
    assert said("scenes.md", "a long side of # pixels or more are localized more exactly") == (PATCH_POSE.min_photo_px,)
    percent, depth = said("scenes.md", "more than some # % of the light (optical depth #, the median")
    assert FLOATERS.max_veil == depth == percent / 100


def test_a_coverage_map_is_measured_as_said() -> None:
    document = "coverage.md"
    assert said(document, "up to a quarter of the distance to what these see") == ()
    assert PLAN.reach == 1 / 4
    assert said(document, "in each # headings") == (PLAN.headings,)
    assert said(document, "**Photos.** # renders, spread evenly") == (COVERAGE.trials,)
    assert said(document, "with a budget of # renders") == (COVERAGE.budget_renders,)
    assert said(document, "at least four photos that it was not trained on") == ()
    assert MIN_PHOTOS == 4
    bounds = said(document, "`localized` within # degrees and # % of the distance")
    assert bounds == (DEFAULT_ACCURACY.deg, 100 * (DEFAULT_ACCURACY.share or 0))


# ------------------------------------------------------------------ live sessions, fleets, readings


def test_live_sessions_are_as_said() -> None:
    settings, document = Settings(scenes=[]), "live.md"
    pattern = "lists them): # sessions, # of a client (a key, or without keys an address), # MB, # frames a second"
    limits = said(document, pattern)
    assert limits[:2] == (settings.live_sessions, settings.live_sessions_of_client)
    assert limits[2:] == (settings.live_frame_bytes / 1e6, settings.live_fps)
    assert said(document, "average over two seconds, # s without a frame") == (settings.live_idle_s,)
    assert _BURST_S == 2
    assert said(document, "The first message is JSON, within # s") == (_HELLO_S,)
    assert said(document, "no hello within # s") == (_HELLO_S,)
    good, quality, most = said(document, "# pixels on the long side and JPEG quality # are good; above # pixels")
    assert (good, most) == (GOOD_PX, MAX_USEFUL_PX)
    assert quality == 80
    assert said(document, "above # megapixels they are refused") == (LIVE.max_pixels / 1e6,)
    assert said(document, "by at most # cm and # degrees a frame") == (100 * FUSION.step, FUSION.step_deg)
    bounds = said(document, "the standard deviation exceeds # degrees or # % of the distance")
    assert bounds == (FUSION.most_turn_deg, 100 * FUSION.most_share)
    assert said(document, "After three seconds without a frame the odometry counts as begun anew") == ()
    assert FUSION.most_gap_s == 3
    assert said(document, "up to four of the last ones that show different things") == ()
    assert 1 + MOST_VIEWS == 4
    assert said(document, "found in the last ten metres") == ()
    assert FUSION.way == 10


def test_a_fleets_times_are_as_said() -> None:
    document = "scale.md"
    lease_s, every_s = said(document, "has a lease of # s, by the database's clock, which its front renews every # s")
    assert JobsConfig().lease_s == lease_s == _RENEWALS * every_s
    assert said(document, "Records are stored every # s") == (_BATCH_S,)
    assert said(document, "A live session has a lease of # s, renewed every # s") == (3 * RENEW_S, RENEW_S)


def test_readings_and_frames_are_trusted_as_said() -> None:
    turned_deg, metres = said("api.md", "# degrees for what a manifest says is up or north, # m for its anchor")
    assert SCENE_UP_SIGMA == ANCHOR_HEADING_SIGMA == np.radians(turned_deg)
    assert metres == ANCHOR_SIGMA_M
    # Of a Gaussian: the quantile of one degree of freedom has 99.9 %, and the likelihood ratio is half of it, e^-5.4.
    (share,) = said("api.md", "A reading that contradicts the photo (beyond # % of what")
    for freedom, bound in enumerate(DEVICE_PRIORS.chi_square, 1):
        assert chi_square_quantile(share / 100, freedom) == pytest.approx(bound, abs=0.01)
    (odds,) = said("api.md", "by a likelihood ratio that the wrong one has in one of # cases")
    assert DEVICE_PRIORS.preferred == pytest.approx(chi_square_quantile(1 - 2 / odds, 1), abs=0.02)
    (tried,) = said("scenes.md", "Where four photos or more lie in the folder, a service localizes up to # of them")
    assert CAMERA_FRAME_CONFIG.tried == tried
    assert CAMERA_FRAME_CONFIG.least == 4
    assert said("scenes.md", "Of more than # photos every second, third and so on") == (DIGEST.max_photos,)


def test_what_the_service_keeps_and_shows_is_as_large_as_said() -> None:
    settings = Settings(scenes=[])
    assert said("deploy.md", "Beyond `SPLATFIX_CACHE_BYTES` (# GB)") == (settings.cache_bytes / 1e9,)
    assert said("deploy.md", "the first hundred each, and of the others together") == ()
    assert _MOST_VALUES == 100
    assert said("api.md", "`expires_in_s`, by default # days") == (ShareIn().expires_in_s / 86_400,)
    assert said("viewer.md", "Of a large scene the # most") == (MAX_SPLATS,)


def test_benches_measure_what_is_said() -> None:
    document = "benchmarks.md"
    assert said(document, "a service as it is taken: # x # at # frames a second") == (640, 480, FILM.fps)
    delay_ms, spread_ms, lost = said(document, "with # +- # ms of delay and # % of frames lost")
    assert (LINK.delay_s, LINK.spread_s, LINK.loss) == (delay_ms / 1e3, spread_ms / 1e3, lost / 100)
    assert said(document, "another place and a pause of # s") == (FILM.locked_s,)
    assert said(document, "a fifth of the picture hidden") == ()
    assert FILM.occluded_share == 1 / 5
    assert said(document, "Frames bring an odometry that drifts by # % of the way") == (100 * ODOMETRY.drift,)
    ratio, nearest = said(document, "matching (ratio #, mutual), pairs (the # nearest poses")
    assert (PEER_MATCHING.ratio, PEER_MATCHING.pairs_of_photo) == (ratio, nearest)
    assert said(document, "of a peer those with # inliers or more") == (MIN_INLIERS,)
    assert said(document, "Of photos in several sizes the smallest of at least # px") == (MIN_LONG_SIDE_PX,)
    bounds = said(document, "the share of photos within # cm and # degree up to # m and # degrees")
    assert (100 * BOUNDS[0][0], BOUNDS[0][1], *BOUNDS[-1]) == bounds
    assert said(document, "`floaters` (a factor of # large faint and # opaque ones)") == (FAINT, OPAQUE)
    millions, metres = said(document, "a synthetic street of # million Gaussians: houses, cars and trees along # m")
    # A unit is three metres.
    assert (STREET.count, 3 * STREET.length) == (1e6 * millions, metres)
    assert said(document, "at ten times that distance, and # floaters, of up to # units") == (STREET.floaters, 40)


def test_hints_show_the_examples_of_the_document() -> None:
    text = " ".join((ROOT / "docs/api.md").read_text("utf-8").split())
    for name in ("intrinsics", "prior", "up_in_camera", "gps", "heading", "times_s"):
        assert json.dumps(EXAMPLES[name]) in text, name
    prior, (first, second) = EXAMPLES["prior"], EXAMPLES["rig"]["cameras"]
    assert EXAMPLES["truth"] == {name: prior[name] for name in ("position", "quaternion_wxyz")}
    # The second camera is beside the first, as far as the document's.
    assert first["intrinsics"] == second["intrinsics"] == EXAMPLES["intrinsics"]
    assert json.dumps(first["rig_from_camera"]) in text
    beside = re.findall(r'"rig_from_camera": (\[\[.*?\]\])', text)[1]
    assert np.array(second["rig_from_camera"])[:, 3].tolist() == np.array(json.loads(beside))[:, 3].tolist()
    assert np.array_equal(np.array(second["rig_from_camera"])[:, :3], np.eye(4)[:, :3])
