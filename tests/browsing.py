"""What the tests in a real browser share: Debian's Chromium, and an app served on a real port."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest
import uvicorn
from axe_playwright_python.sync_playwright import Axe
from fastapi import FastAPI
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright
from two_fronts import KEYS, two_fronts

CHROMIUM = shutil.which("chromium") or ""
# WebGL in software where there is no GPU, which has to be asked for; no services in the background.
FLAGS = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
HTTP = httpx.Client(trust_env=False, verify=False, limits=httpx.Limits(max_keepalive_connections=0))
"""One client for all: each `httpx.get` reads the certificates again, for 30 ms in which the served app stands still."""
PATIENCE_MS = 90_000
"""Software rendering on a busy machine: 20 s were seen for a first picture."""
NEEDS_CHROMIUM = [
    pytest.mark.browser,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not CHROMIUM, reason="there is no chromium on this machine"),
]


@contextmanager
def launched(*flags: str) -> Iterator[Browser]:
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, *flags])
        yield browser
        browser.close()


def opened(browser: Browser, address: str, width: int = 1100, height: int = 700) -> Page:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE_MS)
    sign_in(page.context, address)
    page.goto(address)
    return page


def is_ready(url: str) -> bool:
    """Return whether a service is ready; asked twice, since behind a gateway the fronts answer in turn."""
    return all(HTTP.get(f"{url}/readyz").status_code == 200 for _ in range(2))


def entrance(address: str) -> str:
    """Return the start page of a service; where the tests go through a gateway, with the key that opens a session."""
    url = httpx.URL(address)
    key = KEYS.get(url.port or 0)
    return str(url.copy_with(path="/", query=f"key={key}".encode() if key else None, fragment=None))


def sign_in(context: BrowserContext, address: str) -> None:
    """Get a session where the tests go through a gateway, whose service has keys."""
    if KEYS.get(httpx.URL(address).port or 0):
        context.request.get(entrance(address))


def share_key(address: str, port: int) -> None:
    """Let the keys of a service at a port be known at an address of the test's own that leads to it."""
    if found := KEYS.get(port):
        KEYS[httpx.URL(address).port or 0] = found


def serious(page: Page) -> list[str]:
    """Return what axe finds serious or critical. Headings and landmarks, which viser's page and Swagger UI's lack, are
    moderate findings.
    """
    impacts = ("serious", "critical")
    # The viewer's page names viser's controls in the frame after they came.
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    found = [rule for rule in Axe().run(page).response["violations"] if rule["impact"] in impacts]
    return [f"{rule['id']}: {node['html'][:200]}" for rule in found for node in rule["nodes"]]


@contextmanager
def served(app: FastAPI, port: int = 0) -> Iterator[str]:
    """Serve an app in a thread, or two of what it was made of behind nginx, where that is asked for; gives the URL."""
    if hasattr(app.state, "made"):
        with two_fronts(app, port) as url:
            yield url
        return
    # Streams of open pages would keep it from ending.
    config = uvicorn.Config(
        app, port=port, log_level="critical", ws="websockets-sansio", ws_max_size=2**26, timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive(), "the server did not start"
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
