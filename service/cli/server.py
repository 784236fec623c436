"""The process of `splatfix serve`: a socket, the server, and the lines printed once it is ready."""

from __future__ import annotations

import logging
import os
import socket
import ssl
import sys
import threading
import time
import webbrowser
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from rich.console import Console

from service import __version__
from service.cli.example_request import curl_line
from service.cli.graceful_server import GracefulServer
from service.cli.local_certificate import fingerprint, local_addresses, local_certificate
from service.cli.qr_code import qr_lines
from service.errors import InvalidRequest
from service.logs import json_handler
from service.web.api_keys import KeyRing
from service.web.app import create_app, data_folder
from service.web.routes.dependencies import AppState
from service.web.settings import CONFIG_HOME, DATA_HOME, Settings, is_loopback, unknown_variables

_CONNECTIONS_S = 3
"""Time for open connections after SIGTERM, before the running jobs get their own."""


def run(settings: Settings, out: Console, err: Console, browser: bool = False) -> None:
    """Serve until SIGTERM or SIGINT; with `browser`, open the start page once it is ready.

    Raises InvalidRequest, StorageFailed and what `create_app` raises.
    """
    if settings.log_json if settings.log_json is not None else not err.is_terminal:
        logging.getLogger().handlers = [json_handler()]
    if settings.data_dir is None and settings.port:  # a random port is never the same again
        settings = settings.model_copy(update={"data_dir": DATA_HOME / f"port-{settings.port}"})
    for line in unknown_variables(os.environ):
        err.print(f"warning: {line}", style="yellow", markup=False, highlight=False, soft_wrap=True)
    if settings.https:
        settings = _with_certificate(settings)
    keys = KeyRing(settings.keys_file)
    # Beyond this machine nobody may come in without a key, so one is made where there is none.
    key = "" if keys or settings.open or is_loopback(settings.host) else keys.make_temporary("start", "admin")
    # The socket first: the port is known, and an error is reported before scenes are loaded.
    with _listener(settings.host, settings.port) as listener:
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        # Tried before the server starts, which would print the error with its traceback.
        with data_folder(settings.data_dir):
            pass
        # After the port: the viewer gets the address of the service.
        application = create_app(settings, keys=keys)
        server = http_server(application, settings)
        logging.getLogger("service").setLevel(logging.INFO)
        # A lasting key isn't known here, only its hash.
        shell_key = key or ("$SPLATFIX_KEY" if keys else "")
        arguments = server, application, settings, (key, shell_key), out, err, browser
        threading.Thread(target=_announce, args=arguments, daemon=True).start()
        # A thread that waits for the interpreter asks for it after 0.5 ms instead of 5: tracking is many short kernels,
        # and behind another session each of them would wait for so long.
        sys.setswitchinterval(0.0005)
        server.run(sockets=[listener])


def http_server(application: FastAPI, settings: Settings) -> uvicorn.Server:
    """Return the server of an app; `run` serves on the sockets that it is given until SIGTERM or SIGINT."""
    return GracefulServer(
        uvicorn.Config(
            application,
            # Its lines go through this process' handlers, like all others.
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            ws="websockets-sansio",
            ws_max_size=2**26,
            ws_per_message_deflate=False,  # scenes are sent whole: compressing them costs more than it saves
            # Uploads may take as long as jobs.
            timeout_graceful_shutdown=max(_CONNECTIONS_S, round(settings.shutdown_s)),
            ssl_certfile=settings.certificate if settings.https else None,
            ssl_keyfile=settings.certificate_key if settings.https else None,
        ),
        lambda: application.state.app_state.jobs.dismiss(),
    )


def _with_certificate(settings: Settings) -> Settings:
    """Return the settings with a certificate: their own, else the local one. Raises InvalidRequest, BackendMissing."""
    given = (settings.certificate, settings.certificate_key)
    if given == (None, None):
        found = local_certificate(CONFIG_HOME / "https", local_addresses())
        given = (found.certificate, found.key)
    certificate, key = given
    if certificate is None or key is None:
        raise InvalidRequest("a certificate needs its key, and a key its certificate.", where="certificate_key")
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(certificate, key)
    except (OSError, ValueError) as error:  # ssl's errors are OSErrors
        raise InvalidRequest(f"not a PEM certificate with its key: {error}.", where=str(certificate)) from error
    return settings.model_copy(update={"certificate": certificate, "certificate_key": key})


def _listener(host: str, port: int) -> socket.socket:
    """Return a bound socket, which listens once the server runs: until then a gateway takes another front."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere it would let two processes have one port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise InvalidRequest(f"can't listen there: {error.strerror}.", where=f"{host}:{port}") from error
    return listener


def _local_certificate(settings: Settings) -> Path | None:
    """Return the certificate if it is this machine's own, which no client knows."""
    certificate = settings.certificate if settings.https else None
    return certificate if certificate and certificate.parent == CONFIG_HOME / "https" else None


def _https_lines(settings: Settings, query: str) -> list[str]:
    """Return what to open on a phone, as text and QR code, and what its browser will ask."""
    addresses = [] if is_loopback(settings.host) else local_addresses()
    lines = [f"  live page   {settings.loopback_url}/live{query}"]
    for address in addresses:
        page = f"https://{address}:{settings.port}/live{query}"
        lines += [f"  on a phone  {page}", *([code] if (code := qr_lines(page)) else [])]
    if certificate := _local_certificate(settings):
        lines += [
            "The certificate is this machine's own: browsers warn once. Accept it only if they show this fingerprint:",
            f"  SHA-256 {fingerprint(certificate)}",
        ]
    return lines


def _announce(
    server: uvicorn.Server,
    application: FastAPI,
    settings: Settings,
    keys: tuple[str, str],
    out: Console,
    err: Console,
    browser: bool,
) -> None:
    """Wait until the service is ready, then print its addresses and an example request, and open the browser if asked.

    `keys` are the key that was made for this run, and what the example takes as a key; each empty if there is none.
    """
    key, shell_key = keys
    app_state = _ready_state(server, application, err)
    readiness, url = app_state.engine.readiness(), settings.loopback_url
    query = f"?key={key}" if key else ""
    for reason in readiness.failed:
        err.print(f"not usable: {reason}", style="red", markup=False, highlight=False, soft_wrap=True)
    lines = [
        f"splatfix {__version__} {'is ready' if readiness.ready else 'runs, but has no usable scene'}:",
        f"  start page  {url}/{query}",
        *([f"  viewer      {url}/viewer/{query}"] if settings.viewer else []),
        f"  API         {url}/docs",
    ]
    if settings.https:
        lines += _https_lines(settings, query)
    if key:
        lines += ["The key was made for this run only; `splatfix keys add NAME` makes lasting ones."]
    if example := _example(app_state, settings, shell_key):
        hint = " (SPLATFIX_KEY: a key from `splatfix keys add NAME`)" if shell_key and not key else ""
        lines += [f"Try it{hint}:", f"  {example}"]
    out.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
    if browser:
        webbrowser.open(f"{url}/{query}")


def _ready_state(server: uvicorn.Server, application: FastAPI, err: Console) -> AppState:
    """Wait until the scenes that are required are in memory; return the app's state."""
    with err.status("starting") as status:
        # uvicorn has no event for it; the app makes its state while it starts.
        while not server.started:
            time.sleep(0.05)
        app_state: AppState = application.state.app_state
        while pending := app_state.engine.readiness().pending:
            status.update(", ".join(map(str, pending)))
            time.sleep(0.1)
    return app_state


def _example(app_state: AppState, settings: Settings, key: str) -> str:
    """Return a command that localizes a photo in the first scene that is ready; empty if there is none."""
    scenes = app_state.engine.scenes()
    ready = [scene.id for scene in scenes if scene.state == "ready"]
    contents = app_state.engine.contents(ready[0]) if ready else None
    if contents is None:
        return ""
    stored = app_state.scene_store.find(ready[0])
    # With one scene a request need not name it: a shorter example.
    named = ready[0] if len(scenes) > 1 else ""
    example = curl_line(settings.loopback_url, stored and stored.path, contents.cameras, scene_id=named, key=key)
    if certificate := _local_certificate(settings):
        example = example.replace("curl ", f"curl --cacert {certificate} ", 1)
    return example
