"""The benches' and the coverage map's simulated cameras: their motion, light and noise are as strong as is stated."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.bench import live_film, track
from service.bench.live_film import FILM, make_film
from service.bench.pose_metrics import Units
from service.bench.track import SEQUENCE, smooth_path
from service.coverage import degraded_renders, plan
from service.coverage.degraded_renders import DEGRADATION, GAMMA, degraded_render
from service.coverage.plan import PLAN
from service.geometry import moved, pose_distance
from service.interfaces import Frame
from service.photos.images import read_query
from service.types import Camera, Intrinsics, Pose

HERE = Pose(np.eye(4))
UNITS = Units(np.zeros(3), 0.5, False)
"""A scene unit is half a normalized one."""
GREY = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


class Grey:
    """Renders a grey value, and tells of which cameras."""

    def __init__(self, value: float = 0.4) -> None:
        self.value, self.cameras = value, []

    def render(self, cameras):
        self.cameras += cameras
        sizes = [(c.intrinsics.height, c.intrinsics.width) for c in cameras]
        flat = [np.full(size, np.float32(self.value)) for size in sizes]
        return [Frame(np.stack([f] * 3, 2), f, f, f) for f in flat]


# ------------------------------------------------------------------ the film of a live session


def test_a_hand_trembles_by_a_quarter_of_a_degree_at_one_to_seven_hertz() -> None:
    rng = np.random.default_rng(0)
    twists = np.concatenate([live_film._tremor(300, UNITS, rng, FILM) for _ in range(60)])
    sigma = np.sqrt(np.mean(twists**2, axis=0))
    # 0.006 normalized units are 0.012 scene units.
    assert sigma == pytest.approx([np.radians(0.25)] * 3 + [0.012] * 3, rel=0.06)
    # 300 frames of 30 a second: ten seconds, so a bin of the spectrum is a tenth of a hertz.
    power = np.mean([np.abs(np.fft.rfft(part[:, 0])) ** 2 for part in np.split(twists, 60)], axis=0)
    hertz = np.fft.rfftfreq(300, 1 / 30)
    assert power[(hertz >= 0.9) & (hertz <= 7.1)].sum() > 0.93 * power.sum()
    for low, high in ((1.0, 1.6), (6.4, 7.0)):
        assert power[(hertz >= low) & (hertz <= high)].mean() > 0.5 * power[(hertz >= 1) & (hertz <= 7)].mean()


def test_a_film_has_its_parts_at_thirty_frames_a_second_and_a_pause_of_thirty_seconds() -> None:
    stations = [moved(HERE, np.array([0, 0.1 * k, 0, 0.2 * k, 0, 0])) for k in range(4)]
    shown = []
    film = make_film(stations, GREY, Grey(), UNITS, 4.0, 0, lambda *now: shown.append(now))  # type: ignore[arg-type]
    counts = {part: sum(shot.part == part for shot in film) for part, _ in FILM.parts}
    # Shares of 120 frames.
    assert counts == {
        "steady": 19,
        "exposure": 19,
        "occluded": 19,
        "dark": 12,
        "blurred": 19,
        "jumped": 16,
        "unlocked": 16,
    }
    gaps = np.diff([shot.time_s for shot in film])
    assert gaps == pytest.approx([1 / 30] * (len(film) - 17) + [30 + 1 / 30] + [1 / 30] * 15)
    assert shown == [(k + 1, 120) for k in range(len(film))]
    steady = read_query(film[0].jpeg).rgb / 255
    assert steady.mean() == pytest.approx(0.4, abs=0.01)
    # Noise of 0.02 a channel; JPEG halves that of colours, and keeps most of the brightness's.
    assert 0.006 < (steady.mean(2) - steady.mean()).std() < 0.014


@pytest.mark.parametrize(("second", "gain"), [(0, 1.0), (1, 0.6), (2, 1.5), (3, 0.8), (4, 1.0)])
def test_the_exposure_changes_each_second(second: int, gain: float) -> None:
    image = np.full((48, 64, 3), np.float32(0.4))
    for number in (30 * second, 30 * second + 29):
        seen = live_film._altered("exposure", image, number, np.random.default_rng(0), FILM)
        assert seen == pytest.approx(np.float32(0.4 * gain))
    assert live_film._altered("steady", image, 31, np.random.default_rng(0), FILM) is image


def test_somebody_hides_a_fifth_from_left_to_right_and_back_in_six_seconds() -> None:
    image = np.full((480, 640, 3), np.float32(0.9))
    lefts = []
    for number in (0, 45, 90, 180):
        hidden = (live_film._altered("occluded", image, number, np.random.default_rng(0), FILM) != image).all(2)
        assert hidden.mean() == pytest.approx(0.2, abs=0.005)
        rows, columns = np.nonzero(hidden)
        lefts.append(int(columns.min()))
        assert (int(rows.min()), int(rows.max()), int(np.ptp(columns)) + 1) == (48, 479, 142)
    assert lefts == [0, 249, 498, 0]
    assert (image == np.float32(0.9)).all()


def test_a_blurred_frame_is_the_mean_over_half_of_the_way_to_the_next() -> None:
    path, grey = [HERE, moved(HERE, np.array([0, 0, 0, 0.4, 0, 0]))], Grey()
    live_film._seen("blurred", path, 0, GREY, grey, FILM)  # type: ignore[arg-type]
    assert [camera.pose.position_in_world[0] for camera in grey.cameras] == pytest.approx([-0.1, 0, 0.1])
    # At the end of the way nothing moves.
    live_film._seen("blurred", path, 1, GREY, grey, FILM)  # type: ignore[arg-type]
    assert [camera.pose.position_in_world[0] for camera in grey.cameras[3:]] == pytest.approx([0.4] * 3)
    assert not live_film._seen("dark", path, 0, GREY, grey, FILM).any()  # type: ignore[arg-type]


# ------------------------------------------------------------------ an image sequence


def test_a_path_goes_through_its_stations_at_the_stated_steps_and_back() -> None:
    stations = [HERE, *(moved(HERE, np.array([0, 0, 0, k, 0, 0.0])) for k in (2, 1, 3))]
    path = smooth_path(stations, UNITS, 200)
    positions = np.array([pose.position_in_world[0] for pose in path])
    # 3 scene units are 1.5 normalized ones: 75 frames of 0.02. In nearest-neighbour order the way is straight.
    assert positions[75] == pytest.approx(3.0, abs=1e-2)
    assert np.diff(positions[:75]) == pytest.approx(0.04, abs=2e-3)
    assert positions[150] == pytest.approx(0.0, abs=1e-2)
    assert np.diff(positions[76:150]) == pytest.approx(-0.04, abs=2e-3)
    assert positions[160] == pytest.approx(positions[10], abs=1e-6)


def test_a_turning_path_turns_by_seven_tenths_of_a_degree_a_frame() -> None:
    stations = [moved(HERE, np.array([0, np.radians(7 * k), 0, 0, 0, 0])) for k in range(4)]
    path = smooth_path(stations, UNITS, 31)
    assert [pose_distance(a, b)[0] for a, b in pairwise(path)] == pytest.approx([0.7] * 30, abs=0.03)
    assert pose_distance(path[30], stations[3])[0] < 0.05


def test_frames_have_the_stated_exposure_noise_and_quality(monkeypatch: pytest.MonkeyPatch) -> None:
    grey, seen = Grey(), []
    monkeypatch.setattr(track, "encode_image", lambda rgb, quality: seen.append((rgb, quality)) or b"")
    list(track._render_frames([HERE] * 91, GREY, grey, 0, SEQUENCE))  # type: ignore[arg-type]
    assert {quality for _, quality in seen} == {90}
    gains = np.array([rgb.mean() for rgb, _ in seen]) / 0.4
    # A cycle of 90 frames between 1 / 1.35 and 1.35.
    assert (gains.max(), gains.min()) == pytest.approx((1.35, 1 / 1.35), rel=0.01)
    assert abs(int(np.argmax(gains)) - int(np.argmin(gains))) == pytest.approx(45, abs=4)
    assert gains[90] == pytest.approx(gains[0], rel=0.01)
    assert np.mean([rgb.std() for rgb, _ in seen]) == pytest.approx(0.03, rel=0.05)


# ------------------------------------------------------------------ degraded photos of the coverage map

BARE = replace(
    DEGRADATION, gain_sigma=0.0, white_balance_sigma=0.0, vignetting=(0.0, 0.0), blur_px=(0.01, 0.011),
    noise=(0.0, 0.0), k1_sigma=0.0, focal_sigma=0.0,
)  # fmt: skip


def draws(count: int, call: Any) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([call(rng) for _ in range(count)])


def test_gain_and_white_balance_have_the_stated_spread() -> None:
    even = np.full((4, 4, 3), np.float32(0.2))
    config = replace(BARE, gain_sigma=DEGRADATION.gain_sigma, white_balance_sigma=DEGRADATION.white_balance_sigma)
    light = draws(600, lambda rng: np.log(degraded_renders._lit(even, rng, config)[0, 0].astype(float) / 0.2) * GAMMA)
    assert light[:, 1].std() == pytest.approx(0.3, rel=0.08)
    # Red gains what blue loses.
    balance = (light[:, 0] - light[:, 2]) / 2
    assert balance.std() == pytest.approx(0.06, rel=0.08)
    assert light[:, 0] + light[:, 2] == pytest.approx(2 * light[:, 1], abs=1e-4)


def test_corners_lose_up_to_35_hundredths_of_the_light() -> None:
    even = np.full((101, 101, 3), np.float32(0.5))
    config = replace(BARE, vignetting=DEGRADATION.vignetting)

    def lost(rng: np.random.Generator) -> list[float]:
        lit = degraded_renders._lit(even, rng, config)[..., 0].astype(float)
        return [1 - (lit[at] / 0.5) ** GAMMA for at in ((0, 0), (100, 100), (50, 50), (0, 50))]

    shares = draws(300, lost)
    assert 0 <= shares[:, 0].min() < 0.02
    assert 0.32 < shares[:, 0].max() <= 0.35 * 1.001
    assert shares[:, 1] == pytest.approx(shares[:, 0], rel=0.05)
    assert shares[:, 2] == pytest.approx(0, abs=1e-3)
    # Halfway up the side it is a half of that.
    assert shares[:, 3] == pytest.approx(0.5 * shares[:, 0], rel=0.05, abs=1e-3)


def test_blur_and_noise_fill_their_ranges() -> None:
    edge = np.zeros((40, 800, 3), np.float32)
    edge[:, 400:] = 1.0
    sharp = replace(BARE, blur_px=DEGRADATION.blur_px)

    def sigma(rng: np.random.Generator) -> float:
        row = np.diff(degraded_renders._sensed(edge, rng, sharp)[20, :, 0].astype(float))
        at = np.arange(len(row)) - 399
        return float(np.sqrt((row * at**2).sum()))

    blurs = draws(60, sigma)
    # Sampled at whole pixels, a Gaussian of 0.3 has two neighbours of exp(-1 / 0.18) each.
    assert np.sqrt(2 / (np.exp(1 / 0.18) + 2)) <= blurs.min() < 0.2
    assert 1.1 < blurs.max() <= 1.2
    even = np.full((60, 80, 3), np.float32(0.5))
    noisy = replace(BARE, noise=DEGRADATION.noise)
    noise = draws(80, lambda rng: degraded_renders._sensed(even, rng, noisy).std() / np.sqrt(0.55))
    assert 0.005 * 0.95 < noise.min() < 0.0065
    assert 0.028 < noise.max() <= 0.03 * 1.05
    # Its variance grows with the signal.
    dark = degraded_renders._sensed(np.full((60, 80, 3), np.float32(0.2)), np.random.default_rng(3), noisy)
    light = degraded_renders._sensed(np.full((60, 80, 3), np.float32(0.7)), np.random.default_rng(3), noisy)
    assert light.std() / dark.std() == pytest.approx(np.sqrt(0.75 / 0.25), rel=0.02)


def test_what_is_sent_is_a_jpeg_of_640_pixels_with_a_focal_length_three_hundredths_off(monkeypatch) -> None:
    qualities, lenses, rng = [], [], np.random.default_rng(0)
    monkeypatch.setattr(degraded_renders, "encode_image", lambda rgb, quality: qualities.append(quality) or rgb)
    monkeypatch.setattr(
        degraded_renders, "read_query", lambda rgb, intrinsics: SimpleNamespace(rgb=rgb, intrinsics=intrinsics)
    )
    monkeypatch.setattr(degraded_renders, "undistorted", lambda image, lens: lenses.append(lens) or (image, lens))
    for change in ("_lit", "_sensed"):
        monkeypatch.setattr(degraded_renders, change, lambda rgb, rng, config: rgb)
    camera = Camera(Intrinsics(1280, 960, 1200.0, 1200.0, 640.0, 480.0), HERE)
    grey = Grey()
    photos = [degraded_render(camera, grey, rng) for _ in range(60)]  # type: ignore[arg-type]
    sent = [each.intrinsics for each in photos]
    assert {(k.width, k.height, k.trust) for k in sent} == {(640, 480, "approximate")}
    assert {each.rgb.shape for each in photos} == {(480, 640, 3)}
    factors = np.log([k.fx / 600 for k in sent])
    assert factors.std() == pytest.approx(0.03, rel=0.3)
    assert abs(factors.mean()) < 0.01
    assert 70 <= min(qualities) < 73 < 88 < max(qualities) <= 91
    # Rendered with 3 % of the long side beyond each side, for a lens that bends by 0.02.
    wide = grey.cameras[0].intrinsics
    assert (wide.width, wide.height, wide.cx, wide.cy) == (640 + 2 * 19, 480 + 2 * 19, 320.0 + 19, 240.0 + 19)
    bends = np.array([lens.distortion[0] for lens in lenses])
    assert bends.std() == pytest.approx(0.02, rel=0.3)
    assert all(lens.distortion[1:] == (0.0, 0.0, 0.0) for lens in lenses)


# ------------------------------------------------------------------ the plan


def test_about_64_cells_lie_within_a_quarter_of_the_distance_of_cameras() -> None:
    assert (PLAN.cells, PLAN.headings, PLAN.reach) == (64, 12, 0.25)
    row = np.stack([np.linspace(0, 10, 11), np.zeros(11)], 1)
    cell, middles = plan._cells(row, 1.0, PLAN.cells)
    assert 0.9 * 64 <= len(middles) <= 1.5 * 64
    apart = np.linalg.norm(middles[:, None] - row, axis=2).min(1)
    assert apart.max() <= 1.0
    # Side by side: the nearest other cell is a side away.
    own = np.linalg.norm(middles[:, None] - middles, axis=2) + 100 * np.eye(len(middles))
    assert own.min(1) == pytest.approx(cell)
    # Far-apart cameras: most of the box between them is left out, so cells are smaller than 1 / 64 of it.
    far = np.array([[0.0, 0.0], [50.0, 50.0]])
    small, few = plan._cells(far, 1.0, PLAN.cells)
    assert small == pytest.approx(0.85**8 * np.sqrt(52 * 52 / 64))
    assert len(few) < 64


def test_a_camera_of_the_plan_is_like_the_nearest_one_by_position_and_heading() -> None:
    def placed(x: float, heading: float, pitch: float, focal: float) -> Camera:
        pose = plan.pose_at(np.array([x, 0.0, 1.0]), heading, pitch, np.eye(3))
        return Camera(replace(GREY, fx=focal, fy=focal), pose)

    captured = [placed(0.0, 0.0, 0.1, 50.0), placed(1.9, np.pi, 0.2, 70.0)]
    at = np.array([camera.pose.position_in_world for camera in captured])
    # From 0 the first is at 0 reaches but turned by a chord of 2; the second 1.9 reaches away in the same direction.
    for reach, focal, pitch in ((1.0, 70.0, 0.2), (0.9, 50.0, 0.1)):
        found = plan._camera(np.zeros(2), np.pi, captured, at, np.eye(3), reach, PLAN)
        assert found.intrinsics.fx == focal
        assert found.pose.axis_in_world == pytest.approx([-np.cos(pitch), 0, np.sin(pitch)])
        assert found.pose.position_in_world == pytest.approx([0, 0, 1])


def test_a_pitch_is_85_degrees_at_most() -> None:
    for pitch, expected in ((1.5, np.radians(85)), (-1.5, -np.radians(85)), (1.4, 1.4)):
        pose = plan.pose_at(np.zeros(3), 0.0, pitch, np.eye(3))
        assert np.arcsin(pose.axis_in_world[2]) == pytest.approx(expected)


def test_up_is_the_cameras_own_and_z_where_they_cancel() -> None:
    upright, upside_down = Camera(GREY, HERE), Camera(GREY, Pose(np.diag([-1.0, -1.0, 1.0, 1.0])))
    assert plan.plan_axes([upright], None)[2] == pytest.approx([0, -1, 0])
    assert plan.plan_axes([upright, upside_down], None)[2] == pytest.approx([0, 0, 1])
    assert plan.plan_axes([upright], (0.0, 3.0, 0.0))[2] == pytest.approx([0, 1, 0])


def test_a_place_is_reached_in_sight_of_one_of_its_four_nearest_cameras() -> None:
    captured = np.array([[float(k), 0, 0] for k in range(6)])

    class Walled:
        cell = 0.1

        def free_distance(self, starts, directions, most):
            # Only the camera at x = 4 sees anything, and that a little less far than the place is away.
            return np.where(starts[:, 0] == 4, 3.95, 0.0)

    at = np.array([[-1.0, 0, 0], [8.0, 0, 0], [4.0, 3.9, 0], [4.0, 4.06, 0]])
    # From the first place it is the fifth nearest.
    assert plan._reached(at, captured, Walled()).tolist() == [False, True, True, False]  # type: ignore[arg-type]


def test_pairs_are_spread_over_cells_and_headings_farthest_first() -> None:
    places = SimpleNamespace(
        sees_scene=np.array([[True, True], [True, False], [True, True]]), headings_rad=np.array([0.0, np.pi]),
        positions=np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]), plan_from_world=np.eye(3), cell=1.0,
    )  # fmt: skip
    assert plan.spread(places, 3).tolist() == [[0, 0], [2, 1], [0, 1]]  # type: ignore[arg-type]
    # The opposite heading counts as much as four cells.
    assert plan.spread(places, 9).tolist() == [[0, 0], [2, 1], [0, 1], [2, 0], [1, 0]]  # type: ignore[arg-type]
    places.sees_scene[:] = False
    assert plan.spread(places, 3).shape == (0, 2)  # type: ignore[arg-type]
