"""Videos: read as another program wrote them; what is hostile or broken is refused."""

from __future__ import annotations

import struct
import tempfile
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.errors import InvalidImage
from service.photos import video
from service.photos.video import frame_count, is_video, read_video

KINDS = [("mp4", "mp4v"), ("avi", "MJPG"), ("mkv", "FFV1"), ("webm", "VP80")]


def picture(number: int, size: tuple[int, int]) -> np.ndarray:
    """RGB: red on the left, blue on the right, and above a bar that grows with the number."""
    width, height = size
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[:, : width // 2, 0], rgb[:, width // 2 :, 2] = 200, 200
    rgb[: height // 4, : width * (number + 1) // 16] = 255
    return rgb


def written(ext: str, codec: str, count: int, size: tuple[int, int] = (128, 64), rate: float = 25.0) -> bytes:
    """A video of pictures, made by FFmpeg's encoders."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"video.{ext}"
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), rate, size)
        assert writer.isOpened()
        for number in range(count):
            writer.write(picture(number, size)[:, :, ::-1])
        writer.release()
        return path.read_bytes()


@pytest.mark.parametrize(("ext", "codec"), KINDS)
def test_frames_come_in_order_with_their_times_and_colours(ext, codec):
    data = written(ext, codec, 8)
    assert is_video(data)
    frames = list(read_video(data))
    assert [frame.number for frame in frames] == list(range(8))
    assert [frame.time_s for frame in frames] == pytest.approx([i / 25 for i in range(8)], abs=2e-3)
    for frame in frames:
        error = np.abs(frame.rgb.astype(int) - picture(frame.number, (128, 64)))
        assert np.median(error) < 8  # seen: 0 (FFV1) to 4
        assert error[:16].mean() < 16  # the bar, which tells the frames apart: one further is 8 columns of 155 more


def test_every_nth_frame_keeps_number_and_time():
    frames = list(read_video(written("mp4", "mp4v", 8, rate=10.0), every=3))
    assert [frame.number for frame in frames] == [0, 3, 6]
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.3, 0.6])
    assert np.median(np.abs(frames[2].rgb.astype(int) - picture(6, (128, 64)))) < 8


def test_a_video_that_was_taken_upright_comes_upright():
    """Phones store frames as the sensor has them, and how they are turned in the track's header."""
    data = bytearray(written("mp4", "mp4v", 2))
    matrix = data.index(b"tkhd") + 4 + 4 + 36
    turned = (0, 0x10000, 0, -0x10000, 0, 0, 64 << 16, 0, 0x40000000)  # by 90 degrees clockwise
    data[matrix : matrix + 36] = struct.pack(">9i", *turned)
    (first, _) = read_video(bytes(data))
    assert np.median(np.abs(first.rgb.astype(int) - np.rot90(picture(0, (128, 64)), -1))) < 8


def test_the_number_of_frames_is_told_beforehand():
    assert frame_count(written("mp4", "mp4v", 5)) == 5


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n",
        b"ffconcat version 1.0\nfile /etc/hostname\n",
        b"\x00\x00\x00\x18ftypheic" + bytes(100),
        b"\x00\x00\x00\x18ftypmp42" + bytes(1000),
        b"\x1aE\xdf\xa3" + bytes(1000),
        b"RIFF\xff\xff\xff\xffAVI LIST" + bytes(1000),
    ],
    ids=["nothing", "playlist", "concat", "heic", "mp4", "matroska", "avi"],
)
def test_what_is_no_video_is_refused(data):
    with pytest.raises(InvalidImage):
        list(read_video(data))


@pytest.mark.parametrize(("ext", "codec"), KINDS)
def test_a_damaged_video_gives_the_frames_before_the_damage_or_an_error(ext, codec):
    data = written(ext, codec, 8)
    rng = np.random.default_rng(0)
    for cut in (0.05, 0.3, 0.7):
        broken = bytearray(data[: int(len(data) * cut)])
        for spoilt in (broken, broken[: len(broken) // 2] + rng.bytes(len(broken) // 2)):
            try:
                frames = list(read_video(bytes(spoilt)))
            except InvalidImage:
                continue
            assert 1 <= len(frames) <= 8


def test_large_frames_are_refused_before_they_are_decoded(monkeypatch):
    monkeypatch.setattr(video, "MAX_FRAME_PIXELS", 128 * 64 - 1)
    with pytest.raises(InvalidImage, match="128 x 64"):
        next(read_video(written("mp4", "mp4v", 2)))


def child_that(folder: Path, does: str, before: str) -> Path:
    """The decoder's program with a line more."""
    whole = video._CHILD.read_text()
    assert whole.count(before) == 1
    indent = before[: len(before) - len(before.lstrip())]
    child = folder / "child.py"
    child.write_text(whole.replace(before, f"{indent}import os, time\n{indent}{does}\n{before}"))
    return child


@pytest.mark.parametrize("does", ["os.kill(os.getpid(), 11)", "time.sleep(60)"], ids=["crash", "hang"])
def test_a_decoder_that_crashes_or_hangs_is_a_broken_video(monkeypatch, tmp_path, does):
    monkeypatch.setattr(video, "_FRAME_S", 1.0)
    monkeypatch.setattr(video, "_CHILD", child_that(tmp_path, does, "    video = _opened"))
    with pytest.raises(InvalidImage, match="crashed or took too long"):
        list(read_video(written("mp4", "mp4v", 8)))


def test_a_crash_on_the_way_leaves_the_frames_before_it(monkeypatch, tmp_path):
    crash = "if number == 3: os.kill(os.getpid(), 11)"
    monkeypatch.setattr(video, "_CHILD", child_that(tmp_path, crash, "        if number % every == 0:"))
    assert [frame.number for frame in read_video(written("mp4", "mp4v", 8))] == [0, 1, 2]


def test_a_reader_that_stops_early_leaves_no_process(monkeypatch, tmp_path):
    """Nor waits for the next frame."""
    slow = child_that(tmp_path, "if number == 1: time.sleep(20)", "        if number % every == 0:")
    monkeypatch.setattr(video, "_CHILD", slow)
    children = Path(f"/proc/self/task/{threading.get_native_id()}/children")
    others = children.read_text().split()  # of tests before this one
    frames = read_video(written("mp4", "mp4v", 8))
    next(frames)
    assert len(children.read_text().split()) == len(others) + 1
    began = time.monotonic()
    frames.close()
    assert time.monotonic() - began < 10
    assert children.read_text().split() == others
