"""What the hostile runs (fuzz_run, contract_run, load_run) found, and what reading for it found, stays mended."""

from __future__ import annotations

import io
import json
import re
import socket
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from api_server import (
    ROOT,
    assert_problem,
    key_line,
    photo,
    post,
    ready_service,
    scene_files,
    traces_of_uploads,
    until,
)
from PIL import Image
from stand_ins import TURNED
from test_scenes import TRANSFORMS, ply

from service.errors import CorruptScene, InvalidImage, SceneError, UnsupportedFormat
from service.photos import images
from service.photos.images import read_query
from service.scene_formats import load_scene

HALF_PAIR = '"\\ud800"'
"""Half of a surrogate pair: JSON lets it through, UTF-8 doesn't."""

# ------------------------------------------------------------------ photos


def test_a_heic_that_crashes_its_decoder_is_a_broken_photo(monkeypatch):
    """2100 bytes on which libheif 1.23 reads where nothing is (atheris); in this process that would end the service."""
    monkeypatch.delitem(sys.modules, "pi_heif", raising=False)  # of another test
    with pytest.raises(InvalidImage, match="crashed"):
        read_query((ROOT / "tests" / "data" / "segfault.heic").read_bytes())
    assert "pi_heif" not in sys.modules


def test_a_heic_with_too_many_pixels_is_not_decoded(monkeypatch):
    monkeypatch.setattr(images, "_DECODERS", tuple((*d[:2], 100, d[3]) for d in images._DECODERS))
    with pytest.raises(InvalidImage, match="megapixels"):
        read_query((ROOT / "tests" / "data" / "rotated.heic").read_bytes())


def scans(count: int) -> bytes:
    """A progressive JPEG of 64 megapixels in 400 kB whose last scan is repeated."""
    file = io.BytesIO()
    Image.new("L", (8192, 8192)).save(file, "jpeg", progressive=True)
    data = file.getvalue()
    last = data[data.rindex(b"\xff\xda") : -2]
    return data[:-2] + count * last + b"\xff\xd9"


def test_a_jpeg_of_endless_scans_is_refused_by_its_markers():
    """Each scan of 50 bytes takes 10 ms and more: 50 MB of them took hours."""
    began = time.process_time()
    with pytest.raises(InvalidImage, match="scans"):
        read_query(scans(10_000))
    assert time.process_time() - began < 1  # seen: 0.03, and the time to make it
    assert read_query(photo(progressive=True)).rgb.shape == (64, 96, 3)


def test_what_follows_a_jpeg_is_not_counted():
    """Phones append a video, others a preview."""
    assert read_query(photo() + 1000 * b"\xff\xda\x00\x02").rgb.shape == (64, 96, 3)


def test_webp_which_is_decoded_whole_has_a_lower_limit():
    """64 megapixels in 3 kB of WebP took 1.8 GB and 3.7 s; 26 take 0.43 GB. As a PNG they take 0.3 GB and 0.3 s."""
    webp, png = io.BytesIO(), io.BytesIO()
    Image.new("L", (6000, 5000)).save(webp, "webp", lossless=True)
    with pytest.raises(InvalidImage, match="the limit is 26"):
        read_query(webp.getvalue())
    Image.new("L", (8000, 8000)).save(png, "png")
    assert read_query(png.getvalue()).rgb.shape == (1000, 1000, 3)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "P", "1", "I;16", "CMYK"])
def test_a_photo_is_the_same_in_bands(mode, monkeypatch):
    pixels = np.random.default_rng(1).integers(0, 256, (60, 50, 4), np.uint8)
    image = Image.fromarray(pixels)
    if mode == "I;16":
        image = Image.fromarray(pixels[:, :, 0].astype(np.uint16) * 257)
    else:
        image = image.convert(mode)
    file = io.BytesIO()
    image.save(file, "jpeg" if mode == "CMYK" else "png", **({"transparency": 3} if mode == "P" else {}))
    whole = read_query(file.getvalue(), background_rgb=(0.2, 0.4, 0.6))
    monkeypatch.setattr(images, "DEFAULTS", replace(images.DEFAULTS, band_pixels=7 * 50))
    banded = read_query(file.getvalue(), background_rgb=(0.2, 0.4, 0.6))
    assert np.array_equal(banded.rgb, whole.rgb)
    assert banded.warnings == whole.warnings
    assert (banded.valid_mask is None) == (whole.valid_mask is None)
    assert whole.valid_mask is None or np.array_equal(banded.valid_mask, whole.valid_mask)


# ------------------------------------------------------------------ scenes


def folder(place: Path, **files: bytes | str) -> Path:
    """`__` in a name stands for a slash, `_dot_` for a dot."""
    for name, content in {"scene_dot_ply": ply(), **files}.items():
        path = place / name.replace("__", "/").replace("_dot_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return place


def with_frame(**changes) -> str:
    return json.dumps({"fl_x": 9, "frames": [TRANSFORMS["frames"][0] | changes]}).replace('"?"', HALF_PAIR)


@pytest.mark.parametrize(
    "files",
    [
        {"scene_dot_json": f'{{"name": {HALF_PAIR}}}'},
        {"scene_dot_json": '{"metres_per_unit": 1' + 400 * "0" + "}"},
        {"scene_dot_json": json.dumps({"file": 180 * "é" + ".ply"})},
        {"transforms_dot_json": with_frame(file_path="a\0b")},
        {"transforms_dot_json": with_frame(file_path=500 * "a")},
        {"transforms_dot_json": with_frame(file_path="?", w=9, h=9)},
        {"transforms_dot_json": with_frame(w=10**400, h=9)},
        {"sparse__0__cameras_dot_bin": 8 * b"\xff", "sparse__0__images_dot_bin": 8 * b"\xff"},
    ],
)
def test_hostile_files_of_a_folder_are_told_as_scene_errors(tmp_path, files):
    with pytest.raises(SceneError):
        load_scene(folder(tmp_path, **files))


def test_a_compressed_ply_has_all_bounds_of_its_colours_or_none(tmp_path):
    good = (ROOT / "tests" / "data" / "gsply.compressed.ply").read_bytes()
    with pytest.raises(CorruptScene, match="min_b"):
        load_scene(folder(tmp_path, scene_dot_ply=good.replace(b"float min_b\n", b"float odd_b\n")))


# ------------------------------------------------------------------ archives


def archive(*members: tuple[str, bytes], kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as opened:
        for name, content in members:
            member = zipfile.ZipInfo(name or "x")
            member.compress_type, member.filename = kind, name
            opened.writestr(member, content)
    return buffer.getvalue()


GOOD = archive(("room/scene.ply", ply()), ("room/transforms.json", b"{}"))
DEFLATED = GOOD.index(b"scene.ply") + len("scene.ply")
DIRECTORY = GOOD.index(b"PK\x01\x02")
BAD_ARCHIVES = {
    "damaged data": GOOD[: DEFLATED + 9] + b"\xff\xff\xff\xff" + GOOD[DEFLATED + 13 :],
    "an offset before the file": GOOD[: DIRECTORY + 42] + b"\xff\xff\xff\xff" + GOOD[DIRECTORY + 46 :],
    "LZMA, whose memory is the sender's choice": archive(("scene.ply", ply()), kind=zipfile.ZIP_LZMA),
    "bzip2": archive(("scene.ply", ply()), kind=zipfile.ZIP_BZIP2),
    "no scene file": archive(("room/transforms.json", b"{}")),
    "two scene files": archive(("a.ply", ply()), ("b.ply", ply())),
    "a name too long for a file": archive((f"{200 * 'é'}.ply", ply())),
    "a manifest that names another file": archive(("scene.ply", ply()), ("scene.json", b'{"file": "b.ply"}')),
}


@pytest.fixture(scope="module")
def uploading(plugins, tmp_path_factory):
    place = tmp_path_factory.mktemp("uploads")
    with ready_service(data_dir=place) as client:
        yield client, place


@pytest.mark.parametrize("name", BAD_ARCHIVES)
def test_a_bad_archive_is_the_senders_fault_and_tells_nothing_of_our_folders(uploading, name):
    client, place = uploading
    answer = client.put("/scenes/new", content=BAD_ARCHIVES[name])
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] in (CorruptScene.code, UnsupportedFormat.code)
    assert str(place) not in answer.text
    assert not traces_of_uploads(place)


def test_absolute_and_empty_names_in_an_archive_do_no_harm(uploading):
    client, place = uploading
    packed = archive(("/scene.ply", ply()), ("", b"x"), ("/oom/transforms.json", b"{}"))
    assert client.put("/scenes/named", content=packed).status_code == 201
    assert scene_files(place, "named") == ["scene.ply"]
    until(lambda: client.get("/scenes/named").json()["state"] in ("ready", "failed"), 60)
    assert client.delete("/scenes/named").status_code == 204


# ------------------------------------------------------------------ requests


def test_half_a_surrogate_pair_is_no_text(shared):
    def send(path: str, body: str):
        return shared.post(path, content=body, headers={"Content-Type": "application/json"})

    for name in ("scene", "photo", "options", "sced"):
        assert_problem(send("/localize", f'{{"{name}": {HALF_PAIR}}}'), 400, "invalid_request")
    assert_problem(post(shared, options=f'{{"fail": {HALF_PAIR}}}'), 422, "invalid_options", "options")
    pose = f'"pose": {{"world_from_camera": {json.dumps(TURNED.tolist())}}}'
    assert_problem(
        send("/scenes/room/render", f'{{{pose}, "intrinsics": {{{HALF_PAIR}: 1}}}}'), 422, "invalid_intrinsics"
    )
    assert send("/geopose", f'{{"id": {HALF_PAIR}, "sensorReadings": {{}}}}').status_code == 400


def test_a_number_beyond_the_database_is_refused(shared):
    assert_problem(shared.get(f"/jobs?before={2**63}"), 400, "invalid_request", "query.before")
    assert shared.get(f"/jobs?before={2**63 - 1}").status_code == 200


def test_who_sends_a_body_that_nobody_reads_has_the_answer(plugins):
    """Closed at once, the connection would be reset under the sender, and the answer lost."""
    with ready_service(max_upload_bytes=1000) as client:
        body = bytes(5_000_000)
        head = f"POST /localize HTTP/1.1\r\nHost: 127.0.0.1\r\n{key_line(client)}Content-Length: {len(body)}\r\n\r\n"
        with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
            connection.settimeout(20)
            connection.sendall(head.encode())
            time.sleep(0.2)  # the answer is on its way, and the service done with the request
            connection.sendall(body)
            answer = b"".join(iter(lambda: connection.recv(65536), b""))
        assert answer.startswith(b"HTTP/1.1 413 ")
        assert b"content_too_large" in answer


def test_a_bug_is_counted_as_500_and_has_our_headers(plugins):
    with ready_service() as client:
        job = post(client).json()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("service.web.routes.jobs.resources.trace_out", None)
            answer = client.get(job["links"]["trace"])
        assert_problem(answer, 500, "internal_error")
        assert answer.headers["x-request-id"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        told = client.get("/metrics").text
        assert re.search(r'splatfix_requests_total\{.*route="/jobs/\{job_id\}/trace",status="500"\} 1', told)


# ------------------------------------------------------------------ what decides what is read


def test_no_reader_unpickles():
    """numpy's and torch's files may hold code; so may yaml's and marshal's."""
    forbidden = "|".join(
        (
            *(r"import pickle", r"pickle\.", r"torch\.load\((?!.*weights_only=True)", r"allow_pickle=True"),
            *(r"yaml\.(unsafe_)?load\b", r"\bmarshal\b", r"(?<![.\w])(eval|exec)\("),
        )
    )
    for path in (ROOT / "service").rglob("*.py"):
        assert not re.search(forbidden, path.read_text("utf-8")), path
    for path in (ROOT / "service").rglob("*.py"):
        for call in re.findall(r"np\.load\([^\n]*", path.read_text("utf-8")):
            assert "allow_pickle=False" in call, path
