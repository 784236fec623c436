"""Two fronts with keys behind nginx, in place of the one server that a test of the API or of the pages asks for.

    SPLATFIX_TEST_GATEWAY=1 python -m pytest -n 0 tests/test_api.py ...

By hand: the fronts are processes of their own, on a database of PostgreSQL and a shared folder of objects, and nginx,
as docker/nginx configures it, takes them in turn. Where a test gives no keys there is one of an admin, which clients
of this process send and browsers sign in with. What only one process has breaks its test; `NOT_THROUGH_A_GATEWAY`
lists those that are not about HTTP alone.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
import uvicorn
import websockets.sync.client
from fastapi import FastAPI
from gateway import behind_nginx, free_port
from postgres_server import Server, postgres_server
from pydantic import SecretStr
from stand_ins import FileEvent, Packed, set_up_engine

import service.web.app
from service.jobs.embedded_engine import EmbeddedEngine
from service.web.api_keys import KeyRing
from service.web.key_file import add_key
from service.web.settings import Settings
from service.web.shared_state import LocalState
from service.web.viewer_relay import Relay

THROUGH_A_GATEWAY = os.environ.get("SPLATFIX_TEST_GATEWAY") == "1"
FRONTS = 2 if THROUGH_A_GATEWAY else 1
"""So many processes answer a test's requests, in turn; each has a queue, workers and scenes in memory of its own."""
_CHANGES = "changes the service in the test's process"
_READS = "reads the state, the log or the metrics of one process"
_MEMORY = "each front has scenes of its own in memory, unless they share an engine by Ray"
_FOLDER = "goes on from the folder of a service without a database"
_HEADER = "sends X-Forwarded-Prefix, which the gateway sets itself"
_VIEWER = "has a viewer of its own in the test's process"
_OPEN = "is about a service without keys"
NOT_THROUGH_A_GATEWAY: dict[str, str] = {
    # test_api.py
    "test_a_quiet_stream_is_kept_alive": _CHANGES,
    "test_a_scene_still_loading_is_not_ready": _CHANGES,
    "test_a_bug_in_a_route_is_a_problem_document_without_details": _CHANGES,
    "test_links_carry_the_sub_path_of_a_proxy": _HEADER,
    # test_clients.py
    "test_the_curl_lines_work_as_written[False]": _OPEN,
    # test_coverage.py
    "test_the_api_measures_in_the_background_and_tells_what_went_wrong": _CHANGES,
    # test_durable.py
    "test_after_a_crash_every_job_is_done_once": _FOLDER,
    "test_a_stream_goes_on_after_a_restart": _FOLDER,
    "test_a_cancelled_job_stays_cancelled_over_a_crash": _FOLDER,
    "test_a_job_that_was_there_in_every_crash_is_given_up": _FOLDER,
    "test_a_job_whose_scene_is_gone_is_interrupted_with_the_reason": _FOLDER,
    "test_a_stopped_service_finishes_or_puts_back_what_runs": _CHANGES,
    "test_a_service_that_ends_answers_who_has_connected_and_ends_streams": _FOLDER,
    "test_a_folder_has_one_service": _FOLDER,
    "test_a_photo_that_cannot_be_written_is_not_accepted": _CHANGES,
    "test_a_result_waits_until_the_disk_has_room": _CHANGES,
    # test_errors.py
    "test_errors.py": "brings parts of the service into states by changing them in the test's process",
    # test_hostile.py
    "test_a_bug_is_counted_as_500_and_has_our_headers": _CHANGES,
    # test_key_scopes.py, test_keys_api.py
    "test_the_viewer_shows_what_its_user_may_see": _VIEWER,
    "test_readiness_names_no_scene_to_others": _CHANGES,
    "test_a_key_for_one_run_is_listed_and_revoked": "makes a key that only the test's process knows",
    "test_each_act_of_an_admin_is_told_in_the_log": _READS,
    "test_a_service_without_keys_makes_none_over_http": _OPEN,
    # test_live.py
    "test_a_client_that_leaves_is_no_error": _READS,
    # test_registration_api.py
    "test_a_job_keeps_the_revision_that_it_was_accepted_with": _READS,
    # test_scene_memory.py
    "test_a_failed_load_is_tried_again_by_a_later_request": _CHANGES,
    # test_scenes.py
    "test_a_restart_brings_back_a_scene_that_a_waiting_job_needs": "copies the folder of a service that runs",
    # test_security.py
    "test_a_name_that_points_here_by_trick_is_refused": _OPEN,
    "test_logs_have_ids_and_no_secrets": _READS,
    "test_what_viewer_and_pages_poll_is_not_logged": _READS,
    # test_pages.py
    "test_a_scene_is_added_unloaded_loaded_and_deleted": _MEMORY,
    "test_a_scenes_coverage_is_measured_and_drawn": _CHANGES,
}
"""Tests, or files of them, that can't speak through a gateway to another process, and why."""
KEYS: dict[int, str] = {}
"""The key that clients send to the gateway at a port, unless they have one of their own."""
_OPENED = ExitStack()
"""What lasts as long as the tests; `close` ends it."""


@dataclass(frozen=True, slots=True)
class Made:
    """What `create_app` was given: of this each front makes an app of its own."""

    settings: Settings
    scenes: Mapping[str, Packed]
    keys: KeyRing | None
    go_on: FileEvent | None
    """Of the estimators of tests/fake_estimators; None: without them, and without scenes."""
    viewer_port: int | None = None
    """Of a viewer that the test stands in for."""


@cache
def _processes() -> ForkServerContext:
    """Where fronts are forked from: a process that has imported all they need."""
    processes = mp.get_context("forkserver")
    processes.set_forkserver_preload(["front_imports"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # Python 3.11 tells it no other way
        forkserver.ensure_running()
    return processes


@cache
def _database_server() -> Server:
    return _OPENED.enter_context(postgres_server())


@cache
def _folder() -> Path:
    folder = Path(_OPENED.enter_context(tempfile.TemporaryDirectory(prefix="g", ignore_cleanup_errors=True)))
    folder.chmod(0o755)  # nginx's worker is another user's where root runs the tests
    return folder


@cache
def _database(data_folder: Path) -> str:
    """Return the database of a service: the same when it is started again on its folder."""
    return _database_server().database()


@cache
def _key_file(data_folder: Path) -> tuple[Path, str]:
    """Make the file of keys of a service whose test gives none, with a key; the same when it is started again."""
    file = data_folder / "keys.json"
    return file, add_key(file, "tester", "admin")


def close() -> None:
    _OPENED.close()


def run_front(made: Made, port: int) -> None:
    """Serve one front until SIGTERM."""
    engine = EmbeddedEngine(made.settings.engine_config)
    if made.go_on:
        set_up_engine(made.scenes, made.go_on, engine)
    app = service.web.app.create_app(made.settings, engine, made.keys)
    if made.viewer_port:
        app.include_router(relay_to(made.viewer_port, made.keys).router)
    options = {"log_level": "critical", "ws": "websockets-sansio", "ws_max_size": 2**26, "timeout_graceful_shutdown": 1}
    uvicorn.Server(uvicorn.Config(app, port=port, **options)).run()


def relay_to(port: int, keys: KeyRing | None) -> Relay:
    """Return what passes requests below /viewer on to a port."""
    return Relay(SimpleNamespace(port=port, started=0.0), keys or KeyRing(None))


@contextmanager
def two_fronts(app: FastAPI, port: int = 0) -> Iterator[str]:
    """Run two fronts of what an app was made of, and nginx before them, at a port or any; gives the gateway's URL."""
    made: Made = app.state.made
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=_folder(), ignore_cleanup_errors=True)))
        folder.chmod(0o755)
        settings, key = _shared(made, folder)
        ports = [free_port(), free_port()]
        data = made.settings.data_dir or folder
        # Before the fronts, so that it is there until they have ended, and hands on what they say then.
        url = stack.enter_context(behind_nginx(ports, folder / "nginx", port=port, access_log=access_log()))
        processes = []
        for number, own_port in enumerate(ports):
            own = settings.model_copy(update={"port": own_port, "data_dir": data / f"front{number}"})
            front = replace(made, settings=own)
            process = _processes().Process(target=run_front, args=(front, own_port), daemon=True)
            process.start()
            stack.callback(_end, process)
            processes.append(process)
        for process, own_port in zip(processes, ports, strict=True):
            stack.callback(process.terminate)
            _until_served(process, own_port)
        at = httpx.URL(url).port or 0
        if key:
            KEYS[at] = key
            stack.callback(KEYS.pop, at)
        app.state.app_state = _stores(settings, stack)
        yield url


def _stores(settings: Settings, stack: ExitStack) -> SimpleNamespace:
    """Open what fronts share for tests that put something there, as if a third front had done it."""
    from service.jobs.postgres_database import PostgresDatabase
    from service.jobs.postgres_store import PostgresJobStore, PostgresLensStore
    from service.web.postgres_state import PostgresState

    assert settings.database
    database = PostgresDatabase(settings.database.get_secret_value())
    stack.callback(database.close)
    keys = KeyRing(settings.keys_file)
    keys.keep_sessions(PostgresState(database, LocalState(Path(os.devnull))).secret())
    jobs = SimpleNamespace(_store=PostgresJobStore(database))
    return SimpleNamespace(jobs=jobs, lenses=PostgresLensStore(database, settings.keep_lenses), keys=keys)


def _shared(made: Made, folder: Path) -> tuple[Settings, str]:
    """Return the settings of both fronts, and the key that was made where the test gives none."""
    data = made.settings.data_dir or folder
    data.mkdir(parents=True, exist_ok=True)
    changes: dict = {"database": made.settings.database or SecretStr(_database(data))}
    changes["object_store"] = made.settings.object_store or str(data / "objects")
    key = ""
    if not (made.keys or KeyRing(made.settings.keys_file)):
        changes["keys_file"], key = _key_file(data)
    return made.settings.model_copy(update=changes), key


def _until_served(process: BaseProcess, port: int) -> None:
    while True:
        assert process.is_alive(), "a front ended at its start"
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        time.sleep(0.01)


def _end(process: BaseProcess) -> None:
    process.join(30)
    if process.is_alive():
        process.kill()
        process.join()


def access_log() -> Path:
    """Return the log of all gateways: a line for each request, with the port of the front that answered."""
    return _folder() / "requests"


def send_keys() -> None:
    """From now on clients of this process send a gateway's key, unless they have another one, or a session."""
    for client in (httpx.Client, httpx.AsyncClient):
        build = client.build_request
        client.build_request = lambda *a, build=build, **options: _keyed(build(*a, **options))
    connect = websockets.sync.client.connect

    def connect_with_key(uri: str, *, additional_headers: Mapping[str, str] | None = None, **options):
        headers = dict(additional_headers or {})
        if not {"Authorization", "Cookie"} & headers.keys() and (key := KEYS.get(httpx.URL(uri).port or 0)):
            headers["Authorization"] = f"Bearer {key}"
        return connect(uri, additional_headers=headers, **options)

    websockets.sync.client.connect = connect_with_key


def _keyed(request: httpx.Request) -> httpx.Request:
    key = KEYS.get(request.url.port or 0)
    if key and not {"authorization", "cookie"} & request.headers.keys():
        request.headers["Authorization"] = f"Bearer {key}"
    return request
