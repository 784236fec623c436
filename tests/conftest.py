"""What all tests share."""

import gc
import os
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

# As on the command line: threads of a library that wait for one another burn the cores that other tests need. Too late
# if a plug-in of pytest has imported numpy; test_demo.py notices.
os.environ |= dict.fromkeys(
    () if "numpy" in sys.modules else ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)

import pytest
import shape_checks
from hypothesis import settings

# Whoever runs the tests may have keys and settings of their own; the service looks for them when it is imported.
_CONFIG = tempfile.TemporaryDirectory(prefix="splatfix-config-")
os.environ["XDG_CONFIG_HOME"] = _CONFIG.name

shape_checks.install(("service", "viewer"))

# No deadline: the machine may be busy. The same examples every time: a failure must not depend on luck.
settings.register_profile("steady", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("steady")

# These write scenes by gsply, which has no wheel for Linux on ARM.
collect_ignore = [] if find_spec("gsply") else ["test_bench_gpu.py", "test_large_scenes.py", "test_train.py"]

# The API's tests; imported where they are used, since other tests needn't wait for the engine.


def pytest_configure(config: pytest.Config) -> None:
    if os.environ.get("SPLATFIX_TEST_GATEWAY") == "1":
        import gateway_report

        config.pluginmanager.register(gateway_report)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what can't run with the engine of another process, or through a gateway, where that is asked for."""
    reasons: dict[str, str] = {}
    if os.environ.get("SPLATFIX_TEST_ENGINE") == "subprocess":
        from api_server import NOT_IN_A_SUBPROCESS as reasons
    if os.environ.get("SPLATFIX_TEST_GATEWAY") == "1":
        from two_fronts import NOT_THROUGH_A_GATEWAY as reasons
    for item in items:
        names = item.name, item.name.partition("[")[0], item.path.name
        if reason := next((reasons[name] for name in names if name in reasons), None):
            item.add_marker(pytest.mark.skip(reason=reason))


def pytest_collection_finish() -> None:
    """Leave what all tests have imported, some millions of objects, out of each later collection of garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def scene_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for `cache_dir` that all workers of a run share: a scene's view index is built once a run.

    What it holds is named by hashes of all that it depends on. Not for tests of what is built when, or of the cache.
    """
    run = tmp_path_factory.getbasetemp()
    return (run.parent if "PYTEST_XDIST_WORKER" in os.environ else run) / "scene-cache"


@pytest.fixture(scope="module")
def plugins() -> Iterator:
    from api_server import fake_estimators

    with fake_estimators() as stepping:
        yield stepping


@pytest.fixture
def stepping(plugins):
    plugins.GO_ON.clear()
    return plugins


@pytest.fixture(scope="module")
def shared(plugins) -> Iterator:
    """A server for tests that leave nothing behind."""
    from api_server import ready_service

    # Not limited: tests that send much at once follow one another.
    with ready_service(rate_limit="") as client:
        yield client


@pytest.fixture
def client(stepping) -> Iterator:
    from api_server import ready_service

    with ready_service() as client:
        yield client
        stepping.GO_ON.set()


@pytest.fixture(scope="session")
def postgres() -> Iterator:
    """A PostgreSQL server; skips what needs it where there is none."""
    from postgres_server import postgres_server

    with postgres_server() as server:
        yield server


@pytest.fixture(scope="session")
def s3() -> Iterator:
    """What makes a bucket of a server on loopback; skips what needs it where there is none."""
    from object_stores import s3_server

    with s3_server() as bucket:
        yield bucket


@pytest.fixture
def database(postgres) -> Iterator:
    """An empty database in PostgreSQL."""
    from service.jobs.postgres_database import PostgresDatabase

    database = PostgresDatabase(postgres.database())
    yield database
    database.close()
