"""HTTPS: the local certificate, one's own, the addresses that are told, and clients that trust what they were given."""

from __future__ import annotations

import hashlib
import io
import os
import ssl
import sys
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
import uvicorn
from api_server import until
from rich.console import Console
from websockets.sync.client import connect

from service.cli import server
from service.cli.local_certificate import fingerprint, local_certificate
from service.cli.qr_code import qr_lines
from service.client import Client, ServiceError
from service.errors import BackendMissing, InvalidRequest
from service.web.settings import Settings

pytest.importorskip("cryptography")
pytest.importorskip("segno")


@pytest.fixture
def made(tmp_path: Path):
    return local_certificate(tmp_path / "https", ["192.0.2.7", "phone.example"])


def test_a_local_certificate_is_made_once_for_all_names(made, tmp_path):
    told = ssl._ssl._test_decode_cert(str(made.certificate))  # type: ignore[attr-defined]  # OpenSSL's own reading
    names = {value for _, value in told["subjectAltName"]}
    assert names >= {"192.0.2.7", "phone.example", "localhost", "127.0.0.1", "0:0:0:0:0:0:0:1"}
    ends = datetime.strptime(told["notAfter"], "%b %d %H:%M:%S %Y %Z").replace(tzinfo=UTC)
    assert timedelta(days=390) < ends - datetime.now(UTC) < timedelta(days=398)
    if os.name == "posix":
        assert made.key.stat().st_mode & 0o777 == 0o600
    before = made.certificate.read_bytes()
    assert local_certificate(tmp_path / "https", ["192.0.2.7"]).certificate.read_bytes() == before
    # Another address of this machine, or a damaged file: a new one.
    moved = local_certificate(tmp_path / "https", ["192.0.2.8"]).certificate.read_bytes()
    assert moved != before
    made.certificate.write_text("no certificate")
    again = local_certificate(tmp_path / "https", ["192.0.2.8"])
    der = ssl.PEM_cert_to_DER_cert(again.certificate.read_text())
    assert fingerprint(again.certificate).replace(":", "").lower() == hashlib.sha256(der).hexdigest()


def test_clients_trust_the_certificate_that_they_are_given_and_no_other(made, tmp_path):
    async def answer(scope, receive, send) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            await send({"type": "websocket.send", "text": scope["scheme"]})
            await send({"type": "websocket.close"})
        elif scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b'{"scenes": []}'})

    config = uvicorn.Config(
        answer, port=0, log_level="critical", lifespan="off", ws="websockets-sansio",
        ssl_certfile=made.certificate, ssl_keyfile=made.key,
    )  # fmt: skip
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run)
    thread.start()
    try:
        until(lambda: running.started)
        port = running.servers[0].sockets[0].getsockname()[1]
        # By a name that isn't in the certificate, as the viewer does with one's own.
        with Client(f"https://127.1:{port}", certificate=made.certificate, use_proxy=False) as client:
            assert client.scenes() == []
        other = local_certificate(tmp_path / "other", []).certificate
        for trusted in (None, other):
            with Client(f"https://127.0.0.1:{port}", certificate=trusted, use_proxy=False) as client:
                with pytest.raises(ServiceError) as refused:
                    client.scenes()
                assert refused.value.code == "unreachable"
        # What a browser checks that was told to accept it.
        trusting = ssl.create_default_context(cafile=str(made.certificate))
        assert httpx.get(f"https://localhost:{port}", verify=trusting, trust_env=False).status_code == 200
        with connect(f"wss://127.0.0.1:{port}", ssl=trusting, proxy=None) as socket:
            assert socket.recv(10) == "wss"
    finally:
        running.should_exit = True
        thread.join()


def test_settings_take_a_certificate_with_its_key_or_make_one(made, tmp_path, monkeypatch):
    monkeypatch.setattr(server, "CONFIG_HOME", tmp_path / "config")
    own = Settings(https=True, certificate=made.certificate, certificate_key=made.key)
    assert server._with_certificate(own) == own
    local = server._with_certificate(Settings(https=True))
    assert (local.certificate, local.loopback_url) == (
        tmp_path / "config" / "https" / "certificate.pem", "https://127.0.0.1:8000",
    )  # fmt: skip
    with pytest.raises(InvalidRequest, match="certificate_key: a certificate needs its key"):
        server._with_certificate(Settings(https=True, certificate=made.certificate))
    with pytest.raises(InvalidRequest, match="not a PEM certificate with its key"):
        server._with_certificate(Settings(https=True, certificate=made.certificate, certificate_key=made.certificate))


def test_without_the_package_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(BackendMissing, match=r"splatfix\[https\]"):
        local_certificate(tmp_path, [])


def test_the_address_for_a_phone_is_told_as_text_and_as_a_code(made, tmp_path, monkeypatch):
    monkeypatch.setattr(server, "CONFIG_HOME", tmp_path)
    monkeypatch.setattr(server, "local_addresses", lambda: ["192.0.2.7"])
    settings = Settings(https=True, host="0.0.0.0", port=8443, certificate=made.certificate)
    told = server._https_lines(settings, "?key=sfx_1")
    assert told[0] == "  live page   https://127.0.0.1:8443/live?key=sfx_1"
    assert told[1] == "  on a phone  https://192.0.2.7:8443/live?key=sfx_1"
    assert told[2] == qr_lines("https://192.0.2.7:8443/live?key=sfx_1")
    assert "█" in told[2]
    assert told[-1].endswith(fingerprint(made.certificate))
    # On loopback no other machine can come in, and one's own certificate needs no word.
    own = Settings(https=True, certificate=Path("mine.pem"))
    assert server._https_lines(own, "") == ["  live page   https://127.0.0.1:8000/live"]


def test_what_is_announced_begins_with_https():
    out, app_state = io.StringIO(), SimpleNamespace()
    readiness = SimpleNamespace(pending=[], failed=[], ready=False)
    app_state.engine = SimpleNamespace(readiness=lambda: readiness, scenes=list)
    application = SimpleNamespace(state=SimpleNamespace(app_state=app_state))
    settings = Settings(https=True, certificate=Path("mine.pem"))
    arguments = SimpleNamespace(started=True), application, settings, ("", "")
    server._announce(*arguments, Console(file=out), Console(file=io.StringIO()), False)  # type: ignore[arg-type]
    assert "start page  https://127.0.0.1:8000/" in out.getvalue()
    assert "live page   https://127.0.0.1:8000/live" in out.getvalue()
