"""What values may be at most: intrinsics, poses, priors; and the decoders of other processes, part by part."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from service import operating_system
from service.errors import InvalidIntrinsics, InvalidPrior
from service.geometry import look_at, project, reprojection_error_px, se3_exp, se3_log, so3_log
from service.photos import heic_decoder_process, video_decoder_process
from service.results import Reason, Status, Verdict
from service.types import (
    LENS_PRIORS,
    BoxPrior,
    GaussianPosePrior,
    GaussianScene,
    Intrinsics,
    IntrinsicsCorrection,
    Pose,
    Query,
    SceneInfo,
)

CAMERA = Intrinsics(640, 480, 500.0, 510.0, 330.0, 230.0)

# ------------------------------------------------------------------ intrinsics


@pytest.mark.parametrize(
    ("field", "value", "good"),
    [
        ("width", 1, True), ("width", 0, False), ("height", 100_000, True), ("height", 100_001, False),
        ("fx", 1e-9, True), ("fx", 0.0, False), ("fy", 9.99e6, True), ("fy", 1e7, False), ("fx", np.nan, False),
        ("cx", -1e9, True), ("cy", np.inf, False), ("distortion", (np.nan,), False), ("trust", "exactly", False),
    ],
)  # fmt: skip
def test_a_camera_has_bounds(field, value, good):
    if good:
        assert getattr(replace(CAMERA, **{field: value}), field) == value
        return
    with pytest.raises(InvalidIntrinsics) as caught:
        replace(CAMERA, **{field: value})
    assert field in caught.value.where or field == "distortion"


def test_corrections_are_in_long_sides_and_factors():
    correction = IntrinsicsCorrection(1.1, 0.01, -0.02, 0.0)
    found = CAMERA.corrected(correction)
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((550.0, 561.0, 336.4, 217.2))
    upright = Intrinsics(480, 640, 500.0, 500.0, 240.0, 320.0)
    assert upright.corrected(correction).cx == pytest.approx(246.4)
    assert CAMERA.corrected(IntrinsicsCorrection()) is CAMERA
    both = correction.then(IntrinsicsCorrection(2.0, 0.1, 0.2, 0.3))
    assert (both.focal_factor, both.shift_x, both.shift_y, both.k1) == pytest.approx((2.2, 0.11, 0.18, 0.3))
    # A distortion of before is one of a radius that has shrunk by the factor.
    assert IntrinsicsCorrection(k1=0.1).then(IntrinsicsCorrection(2.0, k1=0.05)).k1 == pytest.approx(0.45)


def test_a_pinholes_distortion_is_radial():
    assert CAMERA.distorted(IntrinsicsCorrection(1.1)).model == "PINHOLE"
    found = CAMERA.distorted(IntrinsicsCorrection(k1=0.1))
    assert (found.model, found.distortion) == ("OPENCV", (0.1, 0.0, 0.0, 0.0))
    found = replace(CAMERA, fy=500.0).distorted(IntrinsicsCorrection(k1=0.1))
    assert (found.model, found.distortion) == ("SIMPLE_RADIAL", (0.1,))
    lens = replace(CAMERA, fy=500.0, model="SIMPLE_RADIAL", distortion=(0.2,))
    assert lens.distorted(IntrinsicsCorrection(1.0, 0.1)).distortion == (0.2,)
    assert lens.distorted(IntrinsicsCorrection(2.0)).distortion == pytest.approx((0.8,))
    assert lens.distorted(IntrinsicsCorrection(k1=0.1)).distortion == pytest.approx((0.3,))


def test_distortions_are_added_as_far_as_the_farther_corner(monkeypatch):
    """The principal point is left of and above the middle: the corner is 340 px to the right and 250 px down."""
    seen = []
    monkeypatch.setattr("service.types.composed", lambda *asked: seen.append(asked) or ("RADIAL", (0.5, 0.25)))
    lens = replace(CAMERA, cx=300.0, model="RADIAL", distortion=(0.1, 0.2))
    found = lens.distorted(IntrinsicsCorrection(2.0, k1=0.01))
    assert (found.model, found.distortion, found.fx) == ("RADIAL", (0.5, 0.25), 1000.0)
    assert seen == [("RADIAL", (0.1, 0.2), 2.0, 0.01, pytest.approx(((340 / 1000) ** 2 + (250 / 1020) ** 2) ** 0.5))]
    # Nothing to add, and nothing to add it to.
    assert lens.distorted(IntrinsicsCorrection(shift_x=0.1)).distortion == (0.1, 0.2)
    assert replace(lens, cx=340.0, cy=250.0).distorted(IntrinsicsCorrection(k1=0.01)).model == "RADIAL"
    assert seen[1][4] == pytest.approx(((340 / 500) ** 2 + (250 / 510) ** 2) ** 0.5)


def test_images_are_made_smaller_never_larger():
    for pixels, size in ((320, (320, 240)), (640, (640, 480)), (2000, (640, 480)), (1, (1, 1)), (101, (101, 76))):
        found = CAMERA.with_long_side(pixels)
        assert (found.width, found.height) == size
        assert found.fx == pytest.approx(500 * size[0] / 640)
        assert found.cy == pytest.approx(230 * size[1] / 480)


# ------------------------------------------------------------------ poses and priors


def pose_with(change: Any) -> np.ndarray:
    matrix = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    change(matrix)
    return matrix


def scaled(factor: float) -> Any:
    def change(matrix: np.ndarray) -> None:
        matrix[:3, :3] *= factor

    return change


def last_row(value: float) -> Any:
    def change(matrix: np.ndarray) -> None:
        matrix[3, 3] += value

    return change


def mirrored(matrix: np.ndarray) -> None:
    matrix[:3, 0] *= -1


@pytest.mark.parametrize(
    ("change", "good"),
    [
        (scaled(1.0004), True), (scaled(1.0006), False), (scaled(0.9996), True), (scaled(1e200), False),
        (last_row(9e-10), True), (last_row(1.1e-9), False), (mirrored, False),
    ],
)  # fmt: skip
def test_a_pose_is_rigid_within_printed_digits(change, good):
    matrix = pose_with(change)
    if good:
        inverse = Pose(matrix).camera_from_world
        assert inverse[:3, :3] == pytest.approx(matrix[:3, :3].T)
        assert matrix[:3, :3].T @ matrix[:3, 3] == pytest.approx(-inverse[:3, 3])
    else:
        with pytest.raises(InvalidPrior):
            Pose(matrix)


def test_a_box_has_an_inside():
    BoxPrior(np.zeros(3), np.array([1.0, 1e-9, 2.0]))
    for upper in ([1, 0, 2], [1, -1, 2], [np.nan, 1, 1], [np.inf, 1, 1]):
        with pytest.raises(InvalidPrior, match="two corners"):
            BoxPrior(np.zeros(3), np.array(upper, np.float64))


@pytest.mark.parametrize(
    ("row", "column", "value", "good"),
    [
        (0, 1, 0.999, True), (0, 1, 1.001, False), (2, 2, 0.0, False), (3, 3, -1.0, False), (5, 5, np.nan, False),
        (4, 5, -0.999, True),
    ],
)  # fmt: skip
def test_a_covariance_is_symmetric_and_positive(row, column, value, good):
    units = np.array([1e-6, 1e-6, 1e-3, 1.0, 1e3, 1e3])
    matrix = np.eye(6)
    matrix[row, column] = matrix[column, row] = value
    matrix *= np.outer(units, units)
    if good:
        assert GaussianPosePrior(Pose(np.eye(4)), matrix).covariance.shape == (6, 6)
    else:
        with pytest.raises(InvalidPrior, match="positive definite"):
            GaussianPosePrior(Pose(np.eye(4)), matrix)
    skewed = np.eye(6)
    skewed[0, 1] = 1e-3
    with pytest.raises(InvalidPrior, match="symmetric"):
        GaussianPosePrior(Pose(np.eye(4)), skewed)


def test_approximate_intrinsics_have_a_prior_by_their_source():
    rgb = np.zeros((4, 4, 3), np.uint8)
    about = replace(CAMERA, trust="approximate")
    assert Query(rgb, about, "exif", about).lens_prior == LENS_PRIORS["exif"]
    assert Query(rgb, about, "exif", about, lens_prior=LENS_PRIORS["given"]).lens_prior == LENS_PRIORS["given"]
    assert Query(rgb, CAMERA, "given", CAMERA).lens_prior is None


@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_a_scene_counts_its_bytes_and_degrees(coefficients, degree):
    scene = GaussianScene(
        np.zeros((5, 3), np.float32), np.ones((5, 4), np.float32), np.ones((5, 3), np.float32),
        np.ones(5, np.float32), np.zeros((5, coefficients, 3), np.float32), SceneInfo("s", "S", "0", "ply"),
    )  # fmt: skip
    assert (scene.count, scene.sh_degree, scene.nbytes) == (5, degree, 5 * 4 * (3 + 4 + 3 + 1 + 3 * coefficients))


def test_of_two_answers_acceptance_counts_before_the_place():
    def verdict(status: Status, score: float, place: float | None) -> Verdict:
        return Verdict(status, Reason.VERIFIED, score, 0, 0.0, 0.0, None, (0.02, 0, 0, 0), right_place=place)

    accepted, unsure = verdict(Status.LOCALIZED, 0.1, 0.2), verdict(Status.UNCERTAIN, 0.9, 0.95)
    assert accepted.rank > unsure.rank > verdict(Status.UNCERTAIN, 0.99, 0.94).rank
    assert verdict(Status.UNCERTAIN, 0.7, None).place_probability == 0.7
    assert accepted.focal_sigma == 0.02


# ------------------------------------------------------------------ geometry at its limits


@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-9, 0.99e-4, 1.01e-4, 0.5, 3.1])
def test_logarithms_are_right_on_both_sides_of_their_series(angle):
    """By the definition as a power series, in the same digits."""
    axis = np.array([0.6, 0.0, 0.8])
    twist = np.append(angle * axis, [1.0, -2.0, 0.5])
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(np.eye(3), twist[:3])
    generator[:3, 3] = twist[3:]
    motion = term = np.eye(4)
    for order in range(1, 60):
        term = term @ generator / order
        motion = motion + term
    assert se3_exp(twist) == pytest.approx(motion, abs=1e-12)
    assert se3_log(motion) == pytest.approx(twist, abs=1e-8)
    assert so3_log(motion[:3, :3]) == pytest.approx(cv2.Rodrigues(motion[:3, :3])[0].ravel(), abs=1e-8)


def test_points_behind_the_camera_have_no_error():
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.1, 0.2, 4.0], [0.0, 0.0, 0.0]])
    px = np.array([[333.0, 234.0], [330.0, 230.0], [342.5, 255.5], [330.0, 230.0]])
    found = reprojection_error_px(px, points, CAMERA, Pose(np.eye(4)))
    assert found == pytest.approx([5.0, np.inf, 0.0, np.inf])
    assert project(points[2:3], CAMERA) == pytest.approx(px[2:3])


def test_a_camera_that_looks_almost_along_up_has_that_up():
    level = look_at(np.zeros(3), np.array([1e-5, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])).world_from_camera
    assert level[:3, 1] @ [-1, 0, 0] == pytest.approx(-1)  # what is up lies behind, above the picture's upper edge
    straight = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])).world_from_camera
    assert np.linalg.det(straight[:3, :3]) == pytest.approx(1)


# ------------------------------------------------------------------ decoders


class Video:
    """A capture of frames with time stamps in milliseconds; None: this frame can't be decoded."""

    def __init__(
        self, frames: list[Any], stamps: list[float], count: float = 3, rate: float = 10.0, **size: int
    ) -> None:
        self.frames, self.stamps, self.at, self.opened = frames, stamps, -1, True
        self.values = {
            cv2.CAP_PROP_FRAME_COUNT: count, cv2.CAP_PROP_FPS: rate,
            cv2.CAP_PROP_FRAME_WIDTH: size.get("width", 4), cv2.CAP_PROP_FRAME_HEIGHT: size.get("height", 2),
        }  # fmt: skip

    def isOpened(self) -> bool:
        return self.opened

    def grab(self) -> bool:
        self.at += 1
        return self.at < len(self.frames)

    def retrieve(self) -> tuple[bool, Any]:
        return self.frames[self.at] is not None, self.frames[self.at]

    def get(self, name: int) -> float:
        return self.stamps[self.at] if name == cv2.CAP_PROP_POS_MSEC else self.values[name]


def bgr(value: int = 0, shape: tuple[int, ...] = (2, 4, 3), kind: Any = np.uint8) -> np.ndarray:
    frame = np.zeros(shape, kind)
    frame.flat[0] = value  # blue of the first pixel
    return frame


def decoded(monkeypatch: pytest.MonkeyPatch, video: Video, every: int = 1, most: int = 8) -> list[Any]:
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: video)
    return list(video_decoder_process._decoded(BytesIO(), every, most))


@pytest.mark.parametrize(
    ("count", "told"), [(5.9, 5), (0.0, 0), (-1.0, 0), (9e11, 900_000_000_000), (1e12, 0), (np.nan, 0), (1.0, 1)]
)
def test_a_number_of_frames_is_told_if_it_may_be_true(monkeypatch, count, told):
    assert decoded(monkeypatch, Video([], [], count), every=0) == [({"frames": told}, b"")]


@pytest.mark.parametrize(
    ("stamps", "rate", "times"),
    [
        ([0, 40, 80], 10.0, [0.0, 0.04, 0.08]),
        ([0, 0, 0], 10.0, [0.0, 0.1, 0.2]),  # no stamps
        ([0, 40, 40], 10.0, [0.0, 0.04, 0.14]),
        ([np.nan, 50, 20], 10.0, [0.0, 0.05, 0.15]),
        ([0, 0, 0], 0.1, [0.0, 10.0, 20.0]), ([0, 0, 0], 0.09, [0.0, 1 / 30, 2 / 30]),
        ([0, 0, 0], 1000.0, [0.0, 0.001, 0.002]), ([0, 0, 0], 1001.0, [0.0, 1 / 30, 2 / 30]),
        ([0, 0, 0], np.nan, [0.0, 1 / 30, 2 / 30]),
    ],
)  # fmt: skip
def test_frames_have_the_containers_times_or_follow_evenly(monkeypatch, stamps, rate, times):
    found = decoded(monkeypatch, Video([bgr(1), bgr(2), bgr(3)], stamps, rate=rate))[1:]
    assert [head["time_s"] for head, _ in found] == pytest.approx(times)
    assert [head["number"] for head, _ in found] == [0, 1, 2]
    assert {(head["width"], head["height"]) for head, _ in found} == {(4, 2)}
    assert [pixels[:3] for _, pixels in found] == [b"\0\0\1", b"\0\0\2", b"\0\0\3"]  # RGB


def test_each_nth_frame_is_decoded_up_to_one_that_can_not_be(monkeypatch):
    frames = [bgr(k) for k in range(7)]
    found = decoded(monkeypatch, Video(frames, [0] * 7), every=3)[1:]
    assert [(head["number"], pixels[2]) for head, pixels in found] == [(0, 0), (3, 3), (6, 6)]
    assert [head["time_s"] for head, _ in found] == pytest.approx([0.0, 0.3, 0.6])
    frames[3] = None
    assert len(decoded(monkeypatch, Video(frames, [0] * 7), every=3)) == 2
    assert len(decoded(monkeypatch, Video(frames, [0] * 7), every=2)) == 5


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (bgr(kind=np.uint16), "no colour picture of 8 bits"), (bgr(shape=(2, 4)), "no colour picture"),
        (bgr(shape=(2, 4, 4)), "no colour picture"),
        (bgr(shape=(4, 2, 3)), "frame 1 has 2 x 4 pixels, the first one 4 x 2"),
    ],
)  # fmt: skip
def test_a_frame_of_another_kind_or_size_ends_the_video(monkeypatch, frame, says):
    with pytest.raises(video_decoder_process._Refused, match=says):
        decoded(monkeypatch, Video([bgr(), frame], [0, 0]))


def test_frames_have_at_most_so_many_pixels(monkeypatch):
    assert len(decoded(monkeypatch, Video([bgr()], [0]), most=8)) == 2
    with pytest.raises(video_decoder_process._Refused, match="have 4 x 2 pixels; the limit is 7"):
        decoded(monkeypatch, Video([bgr()], [0]), most=7)
    # The header may lie.
    with pytest.raises(video_decoder_process._Refused, match="frame 0 has 4 x 2 pixels"):
        decoded(monkeypatch, Video([bgr()], [0], width=1), most=7)
    for size in ({"width": 0}, {"height": 0}):
        with pytest.raises(video_decoder_process._Refused, match="can't be opened"):
            decoded(monkeypatch, Video([bgr()], [0], **size))
    closed = Video([bgr()], [0])
    closed.opened = False
    with pytest.raises(video_decoder_process._Refused, match="can't be opened"):
        decoded(monkeypatch, closed)
    decoded(monkeypatch, Video([bgr(shape=(1, 1, 3))], [0], width=1, height=1))


def told_by(monkeypatch: pytest.MonkeyPatch, video: Video) -> list[tuple[dict[str, Any], bytes]]:
    out, found = BytesIO(), []
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: video)
    system = SimpleNamespace(
        argv=["", "1", "8"], stdin=SimpleNamespace(buffer=BytesIO()), stdout=SimpleNamespace(buffer=out)
    )
    monkeypatch.setattr(video_decoder_process, "sys", system)
    video_decoder_process.main()
    out.seek(0)
    while lengths := out.read(8):
        head, pixels = struct.unpack(">II", lengths)
        found.append((json.loads(out.read(head)), out.read(pixels)))
    return found


def test_messages_are_lengths_json_and_pixels(monkeypatch):
    heads = told_by(monkeypatch, Video([bgr(1)], [0]))
    assert [head for head, _ in heads] == [
        {"frames": 3}, {"number": 0, "time_s": 0.0, "width": 4, "height": 2}, {"end": True}
    ]  # fmt: skip
    assert [len(pixels) for _, pixels in heads] == [0, 24, 0]
    refused = told_by(monkeypatch, Video([bgr(), bgr(shape=(4, 2, 3))], [0, 0]))
    assert refused[-1][0]["error"].startswith("frame 1 has")
    assert refused[-1][0]["hint"] == "All frames must have one size."


class Heic:
    """A photo of 4 x 2 pixels."""

    width, height, mode = 4, 2, "RGB"

    def __init__(self, exif: bytes | None, error: Exception | None = None) -> None:
        self.info, self.error, self.loaded = {"exif": exif}, error, False

    def load(self) -> None:
        self.loaded = True
        if self.error:
            raise self.error

    def tobytes(self) -> bytes:
        return b"p" * 24 if self.loaded else b""


def test_a_heic_is_decoded_if_it_is_small_enough(monkeypatch):
    for exif, most, pixels in ((b"Exif", 8, 1), (None, 8, 1), (None, 7, 0)):
        monkeypatch.setattr(heic_decoder_process, "HeifImageFile", lambda data, exif=exif: Heic(exif))
        head, *rest = heic_decoder_process.decoded(b"", most)
        assert head.endswith(b"\n")
        told = json.loads(head)
        assert (told["width"], told["height"], told["mode"]) == (4, 2, "RGB")
        assert told["exif"] == ("RXhpZg==" if exif else "")
        assert rest == [b"p" * 24] * pixels
    for error, says in ((ValueError("torn"), "torn"), (ValueError(), "ValueError")):
        monkeypatch.setattr(heic_decoder_process, "HeifImageFile", lambda data, error=error: Heic(None, error))
        (head,) = heic_decoder_process.decoded(b"", 8)
        assert json.loads(head) == {"error": says}


# ------------------------------------------------------------------ the system


@pytest.mark.parametrize(
    ("system", "cpu_s", "expected"),
    [
        ("linux", 20, [("core", 0), ("memory", 1000), ("cpu", 20)]),
        ("linux", 0, [("core", 0), ("memory", 1000)]),
        ("darwin", 20, [("core", 0), ("cpu", 20)]),
    ],
)
def test_a_child_limits_itself_as_the_system_can(monkeypatch, system, cpu_s, expected):
    set_limits: list[tuple[str, tuple[int, int]]] = []
    resource = SimpleNamespace(
        RLIMIT_CORE="core", RLIMIT_AS="memory", RLIMIT_CPU="cpu", setrlimit=lambda *given: set_limits.append(given)
    )
    monkeypatch.setattr(operating_system, "resource", resource)
    monkeypatch.setattr(operating_system.sys, "platform", system)
    ran: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(operating_system.sys, "argv", ["", "1000", str(cpu_s), "program.py", "a", "b"])

    def run_path(path: str, run_name: str) -> None:
        assert run_name == "__main__"
        ran.append((path, list(operating_system.sys.argv)))

    monkeypatch.setattr(operating_system, "runpy", SimpleNamespace(run_path=run_path))
    operating_system._become_limited()
    assert set_limits == [(kind, (value, value)) for kind, value in expected]
    assert ran == [("program.py", ["program.py", "a", "b"])]
    assert bool(operating_system.missing_limits()) is (system == "darwin")
    monkeypatch.setattr(operating_system, "resource", None)
    set_limits.clear()
    operating_system._limit(1000, 20)
    assert set_limits == []
    assert "no limits" in operating_system.missing_limits()


@pytest.mark.parametrize(
    ("quota", "cores"),
    [("max 100000", 6), ("250000 100000", 2), ("50000 100000", 1), ("900000 100000", 6), ("?", 6), (None, 6)],
)
def test_cores_are_those_of_the_affinity_within_the_quota(monkeypatch, tmp_path, quota, cores):
    path = tmp_path / "cpu.max"
    if quota is not None:
        path.write_text(quota + "\n")
    kept: list[Any] = []
    monkeypatch.setattr(operating_system, "_CPU_QUOTA", path)
    affinity = SimpleNamespace(
        sched_getaffinity=lambda process: set(range(6)), sched_setaffinity=lambda *given: kept.append(given)
    )
    monkeypatch.setattr(operating_system, "_os", affinity)
    assert operating_system.available_cores() == cores
    operating_system.keep_to_cores(77, 2)
    assert kept in ([(77, [0, 1])], [])
