"""What runs where a system lacks what Linux has; paths and files as Windows writes them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from service import operating_system
from service.operating_system import limited_command, locked
from service.scene_formats.folder import load_scene
from service.scene_formats.training_files import same_photo

ROOT = Path(__file__).parents[1]
STUDIO = ROOT / "scenes" / "studio"

# The service with modules that can't be imported and functions that aren't there, as its own command line starts it.
WITHOUT = """
import os, signal, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
for module, names in ((os, ("sched_getaffinity", "getloadavg", "fork")), (signal, ("SIGKILL",))):
    for name in names:
        delattr(module, name)
from service.cli.app import main
main()
"""


def started_without(*arguments: str | Path, folder: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "SPLATFIX_DATA_DIR": str(folder / "data")}
    return subprocess.Popen(
        [sys.executable, "-c", WITHOUT, *map(str, arguments)],
        env=environment,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )


@pytest.mark.ci
def test_the_service_localizes_without_what_other_systems_lack(tmp_path):
    service = started_without("serve", STUDIO, "--port", "0", "--no-viewer", folder=tmp_path)
    try:
        assert service.stdout
        url = None
        while not url:
            line = service.stdout.readline()
            assert line, service.communicate()[1]
            url = re.search(r"start page  (http://[\d.:]+)/", line)
        photo = (STUDIO / "photos" / "photo_00.jpg").read_bytes()
        body = (
            b'--x\r\nContent-Disposition: form-data; name="photo"; filename="p.jpg"\r\n\r\n' + photo + b"\r\n--x--\r\n"
        )
        headers = {"Content-Type": "multipart/form-data; boundary=x", "Prefer": "wait=60"}
        with urllib.request.urlopen(urllib.request.Request(f"{url[1]}/localize", body, headers), timeout=70) as answer:
            assert json.load(answer)["result"]["status"] == "localized"
    finally:
        service.terminate()
        service.communicate(timeout=30)


def test_a_photo_is_decoded_without_limits_and_with(tmp_path, monkeypatch):
    """The limit holds where the system has one, and where it has none the program runs all the same."""
    program = tmp_path / "a program.py"
    program.write_text("import sys; print(sys.argv[1], len(bytearray(int(sys.argv[1]))))", "utf-8")
    command = limited_command(program, 1 << 30, memory_bytes=1 << 29)
    hindered = subprocess.run(command, capture_output=True, text=True)
    assert "MemoryError" in hindered.stderr
    assert not operating_system.missing_limits()
    without = f"import sys; sys.modules['resource'] = None; sys.argv = {command[2:]}; import runpy; "
    without += "runpy.run_path(sys.argv[0], run_name='__main__')"
    free = subprocess.run([sys.executable, "-I", "-c", without], capture_output=True, text=True)
    assert free.stdout.split() == [str(1 << 30)] * 2, free.stderr
    monkeypatch.setattr(operating_system, "resource", None)
    assert "no limits" in operating_system.missing_limits()


def test_a_lock_ends_with_its_process(tmp_path):
    path = tmp_path / "lock"
    code = f"from pathlib import Path; from service.operating_system import locked; x = locked(Path({str(path)!r}))"
    code += "; print('locked', flush=True); import time; time.sleep(60)"
    holder = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert holder.stdout
    assert holder.stdout.readline() == "locked\n"
    with pytest.raises(BlockingIOError):
        locked(path)
    holder.kill()
    holder.communicate()
    locked(path).release()


def written_on_windows(folder: Path) -> None:
    """One Gaussian; a header, a manifest and camera files with CRLF, and a byte order mark where editors put one."""
    rest = [f"{name}_{i}" for name, count in (("f_dc", 3), ("scale", 3), ("rot", 4)) for i in range(count)]
    names = ["x", "y", "z", *rest[:3], "opacity", *rest[3:]]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property float {n}" for n in names)]
    text = "\r\n".join([*header, "end_header", ""]).encode()
    values = np.array([1, 2, 3, 0, 0, 0, 0, -2, -2, -2, 1, 0, 0, 0], "<f4")
    (folder / "scène.ply").write_bytes(text + values.tobytes())
    (folder / "scene.json").write_bytes(b'\xef\xbb\xbf{\r\n"metres_per_unit": 2.0\r\n}\r\n')
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_bytes(b"\xef\xbb\xbf# cameras\r\n1 PINHOLE 64 48 50 50 32 24\r\n")
    (sparse / "images.txt").write_bytes("# images\r\n1 1 0 0 0 0 0 5 1 Müller 1\\été.jpg\r\n\r\n".encode())


def test_a_scene_that_windows_wrote_is_read_under_any_name(tmp_path):
    folder = tmp_path / "Frau Müllers Räume (1) – コピー"
    folder.mkdir()
    written_on_windows(folder)
    scene = load_scene(folder)
    assert scene.means.tolist() == [[1, 2, 3]]
    assert scene.info.metres_per_unit == 2.0
    (camera,) = scene.cameras
    assert camera.camera.pose.world_from_camera[:3, 3].tolist() == [0, 0, -5]
    assert same_photo(camera.name, r"D:\Fotos\Müller 1\été.png")
    assert not same_photo(camera.name, r"D:\Fotos\Müller 2\été.png")


def test_output_that_the_terminal_cannot_show_ends_no_command(tmp_path):
    """Windows redirects in a code page of 256 characters; here it is ASCII."""
    folder = tmp_path / "Räume コピー"
    folder.mkdir()
    written_on_windows(folder)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "service", "scenes", "list", str(folder)]
    listed = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert listed.returncode == 0, listed.stderr
    assert "R?ume" in listed.stdout
