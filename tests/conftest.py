"""What all tests share."""

from collections.abc import Iterator

import pytest
import shape_checks
from hypothesis import settings

shape_checks.install(("service", "viewer"))

# No deadline: the machine may be busy. The same examples every time: a failure must not depend on luck.
settings.register_profile("steady", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("steady")

# The API's tests; imported where they are used, since other tests needn't wait for the engine.


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

    with ready_service() as client:
        yield client


@pytest.fixture
def client(stepping) -> Iterator:
    from api_server import ready_service

    with ready_service() as client:
        yield client
        stepping.GO_ON.set()
