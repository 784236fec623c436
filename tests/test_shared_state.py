"""What every shared state promises: of one process, and of several fronts in PostgreSQL."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from api_server import until
from postgres_server import POSTGRES

from service.errors import RateLimited
from service.web.shared_state import LocalState, Rate, SessionLimits, SharedState, parse_rate

TWO = SessionLimits(all=3, of_client=2)


@pytest.fixture(params=["local", POSTGRES])
def fronts(request, tmp_path) -> Iterator[tuple[SharedState, SharedState]]:
    """What two fronts have; of one process the same twice."""
    local = LocalState(tmp_path / "sessions.key")
    if request.param == "local":
        yield local, local
        return
    address = request.getfixturevalue("postgres").database()  # which skips the test where there is none
    from service.jobs.postgres_database import PostgresDatabase
    from service.web.postgres_state import PostgresState

    databases = [PostgresDatabase(address) for _ in range(2)]
    first, second = (PostgresState(database, local) for database in databases)
    yield first, second
    for database in databases:
        database.close()


@pytest.fixture
def at(request, fronts, monkeypatch) -> Callable[[float], None]:
    """Sets the clock by which rates are counted, to seconds since 1970."""

    def set_local(now: float) -> None:
        monkeypatch.setattr(time, "time", lambda: now)

    if isinstance(fronts[0], LocalState):
        return set_local
    from service.web import postgres_state

    hit, clock = postgres_state._HIT, postgres_state._NOW

    def set_database(now: float) -> None:
        monkeypatch.setattr(postgres_state, "_HIT", hit.replace(clock, f"{now}::float8"))
        monkeypatch.setattr(postgres_state, "_NOW", f"{now}::float8")

    return set_database


def test_the_secret_is_the_same_at_all_fronts_and_after_a_restart(fronts):
    first, second = fronts
    assert isinstance(first, SharedState)
    assert len(first.secret()) == 32
    assert first.secret() == second.secret() == first.secret()


def test_a_rate_is_that_of_all_fronts_together(fronts, at):
    first, second = fronts
    rate = Rate(3, 60)
    at(6_000_015.0)  # 15 s into a period
    assert [front.hit("ann", rate) for front in (first, second, first)] == [None] * 3
    for front in fronts:
        assert front.hit("ann", rate) == pytest.approx(45.0, abs=0.01)
    assert second.hit("bob", rate) is None
    assert second.hit("ann", Rate(1, 3600)) is None  # another rate is another count


def test_the_last_period_counts_with_the_part_of_it_that_is_not_over(fronts, at):
    """Four requests in the last period of 60 s; after 10 s five sixths of them count: 3.3, so one more may come."""
    first, second = fronts
    rate = Rate(4, 60)
    at(6_000_001.0)
    assert [first.hit("ann", rate) for _ in range(4)] == [None] * 4
    at(6_000_070.0)
    assert second.hit("ann", rate) is None
    # One of the last period's four is forgotten every 15 s, so there is room after 5 s more.
    assert first.hit("ann", rate) == pytest.approx(5.0, abs=0.01)
    # 4 x 29.5 / 60 = 1.97 of the last period, beside the one of this: two more.
    at(6_000_090.5)
    assert [first.hit("ann", rate) is None for _ in range(3)] == [True, True, False]
    at(6_000_300.0)  # nothing counts any more
    assert [second.hit("ann", rate) is None for _ in range(5)] == [True] * 4 + [False]


def test_of_many_requests_at_once_as_many_pass_as_are_allowed(fronts):
    barrier = threading.Barrier(8)

    def ask(number: int) -> int:
        barrier.wait()
        return sum(fronts[number % 2].hit("ann", Rate(50, 10**9)) is None for _ in range(12))

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(ask, range(8))) == 50


def test_live_sessions_are_counted_at_all_fronts(fronts):
    first, second = fronts
    ids = [front.begin_session("ann", TWO) for front in fronts]
    with pytest.raises(RateLimited, match="for this key reached: 2"):
        first.begin_session("ann", TWO)
    second.begin_session("bob", TWO)
    with pytest.raises(RateLimited, match="of the service reached: 3"):
        second.begin_session("cleo", TWO)
    first.renew_session("ann", ids[0])  # it counts once
    for session in (ids[1], ids[1], "unknown"):
        first.end_session(session)
    assert second.begin_session("cleo", TWO)


def test_of_many_sessions_at_once_as_many_begin_as_are_allowed(fronts):
    barrier = threading.Barrier(6)

    def begin(number: int) -> bool:
        barrier.wait()
        try:
            fronts[number % 2].begin_session(f"c{number}", TWO)
        except RateLimited:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(begin, range(6))) == 3


@pytest.mark.parametrize(("text", "rate"), [("10/second", Rate(10, 1)), ("600 per 2 minutes", Rate(600, 120))])
def test_rates_are_read(text, rate):
    assert parse_rate(text) == rate


@pytest.mark.ci
def test_a_session_of_a_front_that_ended_is_counted_until_its_lease_ends(postgres, tmp_path, monkeypatch):
    from service.jobs.postgres_database import PostgresDatabase
    from service.web import postgres_state

    monkeypatch.setattr(postgres_state, "_LEASE_S", 0.5)
    database = PostgresDatabase(postgres.database())
    state = postgres_state.PostgresState(database, LocalState(tmp_path / "sessions.key"))
    one = SessionLimits(1, 1)
    session = state.begin_session("ann", one)
    with pytest.raises(RateLimited):
        state.begin_session("bob", one)
    time.sleep(0.6)
    assert state.begin_session("bob", one)
    state.renew_session("ann", session)  # it went on after all
    with pytest.raises(RateLimited, match="service reached: 2"):
        state.begin_session("cleo", one)
    database.close()


@pytest.mark.ci
def test_without_the_database_each_front_limits_by_itself(postgres, tmp_path, monkeypatch, caplog):
    from service.jobs.postgres_database import PostgresDatabase
    from service.web import postgres_state

    monkeypatch.setattr(postgres_state, "_ALONE_S", 0.2)
    database = PostgresDatabase(postgres.database())
    state = postgres_state.PostgresState(database, LocalState(tmp_path / "sessions.key"))
    rate = Rate(2, 10**9)
    postgres.stop()
    try:
        assert [state.hit("ann", rate) is None for _ in range(3)] == [True, True, False]
        assert "by this front alone" in caplog.text
    finally:
        postgres.start()
    until(lambda: state.hit("ann", rate) is None)  # what was counted alone isn't carried over
    database.close()
