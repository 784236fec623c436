"""What a key may be given, how that is stored, and when it ends."""

from __future__ import annotations

import json
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.app import app
from service.errors import InvalidRequest, KeyNotFound
from service.web.api_keys import KeyRing
from service.web.key_file import UNLIMITED, KeyLimits, add_key, expiry, read_keys, remove_key
from service.web.shared_state import LocalState


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "keys.json"


def test_limits_come_back_from_the_file(file: Path) -> None:
    limits = KeyLimits(("lab", "floor-*"), "10/second", 0.5, 4e9)
    add_key(file, "robot", "localize", limits)
    add_key(file, "boss", "admin")
    robot, boss = read_keys(file)
    assert (robot.name, robot.role, robot.limits) == ("robot", "localize", limits)
    assert boss.limits == UNLIMITED
    assert time.time() - 60 < (boss.created or 0) <= time.time()


def test_a_file_of_before_there_were_limits_is_read(file: Path) -> None:
    file.write_text(json.dumps([{"name": "old: one", "role": "read", "sha256": "ab" * 32}]))
    (old,) = read_keys(file)
    assert (old.name, old.limits, old.created) == ("old: one", UNLIMITED, None)
    add_key(file, "new", "read")
    assert read_keys(file)[0] == old


@pytest.mark.parametrize(
    ("patterns", "covered", "others"),
    [
        (None, "anything", ""),
        (("lab",), "lab", "lab2 Lab l la"),
        (("floor-*",), "floor- floor-1 floor-10", "floor xfloor-1"),
        (("floor-?", "lab"), "floor-1 lab", "floor-10 floor-"),
        (("floor-[12]",), "floor-1 floor-2", "floor-3"),
    ],
)
def test_patterns_of_scenes(patterns, covered: str, others: str) -> None:
    limits = KeyLimits(patterns)
    assert all(map(limits.cover, covered.split()))
    assert not any(map(limits.cover, others.split()))


@pytest.mark.parametrize(
    ("where", "given"),
    [
        ("scenes", {"scenes": ()}),
        ("scenes", {"scenes": ("a b",)}),
        ("scenes", {"scenes": ("",)}),
        ("rate", {"rate": "10"}),
        ("rate", {"rate": "0/second"}),
        ("queue_share", {"queue_share": 0.0}),
        ("queue_share", {"queue_share": 1.5}),
    ],
)
def test_limits_that_mean_nothing_are_refused(where: str, given: dict) -> None:
    with pytest.raises(InvalidRequest) as refused:
        KeyLimits(**given)
    assert refused.value.where == where
    assert refused.value.hint


def test_what_no_key_can_be(file: Path) -> None:
    with pytest.raises(InvalidRequest, match="all scenes"):
        add_key(file, "boss", "admin", KeyLimits(scenes=("lab",)))
    for name in ("", "a:b", "-x", "x" * 65, "a\nb"):
        with pytest.raises(InvalidRequest, match="name"):
            add_key(file, name, "read")
    with pytest.raises(KeyNotFound, match="nobody"):
        remove_key(file, "nobody")
    assert read_keys(file) == []


def test_ages_and_dates() -> None:
    for text, seconds in (("90m", 5400), ("12h", 43_200), ("30d", 2_592_000), ("2w", 1_209_600)):
        assert abs(expiry(text) - time.time() - seconds) < 5
    assert expiry("2031-02-28") == datetime(2031, 2, 28, tzinfo=UTC).timestamp()
    for text in ("", "0d", "30", "30 d", "2031-02-30", "tomorrow", "-1d"):
        with pytest.raises(InvalidRequest, match="neither"):
            expiry(text)


def test_a_key_ends_with_all_that_stands_for_it(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = add_key(file, "guest", "localize", KeyLimits(expires=time.time() + 1000))
    ring = KeyRing(file)
    guest = ring.caller(key)
    assert guest
    session, link, viewer = ring.token(guest, 9000), ring.share_token("job", 9000, guest), ring.viewer_token(guest)
    assert ring.bearer(session) == guest
    assert (ring.shared_job(link), ring.still_valid(guest)) == ("job", True)
    assert ring.viewer_bearer(viewer)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 1001)
    assert ring.caller(key) is ring.bearer(session) is ring.shared_job(link) is ring.viewer_bearer(viewer) is None
    assert not ring.still_valid(guest)
    # An expired key doesn't open the service to everybody.
    assert ring


def test_the_command_adds_lists_and_removes(file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SPLATFIX_KEYS_FILE", str(file))
    monkeypatch.setenv("SPLATFIX_CONFIG", str(tmp_path / "none.toml"))

    def run(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["keys", *words])
        return done.exit_code, done.output + str(done.exception or "")

    given = ("--scene", "lab", "--scene", "floor-*", "--rate", "600/minute", "--queue-share", "0.5")
    status, key = run("add", "robot", *given, "--expires", "2031-01-31")
    assert status == 0
    robot = KeyRing(file).caller(key.strip())
    assert robot
    assert robot.limits == KeyLimits(("lab", "floor-*"), "600/minute", 0.5, expiry("2031-01-31"))
    assert robot.role == "localize"
    told = run("list")[1]
    for part in ("localize", "robot", "lab, floor-*", "600/minute", "0.5 of the queue", "until 2031-01-31"):
        assert part in told
    assert "neither an age nor a date" in run("add", "other", "--expires", "soon")[1]
    assert run("remove", "robot")[0] == 0
    assert run("list") == (0, "")


def test_a_whole_queue_is_a_share_and_an_id_is_sixteen_digits(file: Path) -> None:
    assert KeyLimits(queue_share=1.0).queue_share == 1.0
    add_key(file, "robot", "localize")
    (robot,) = read_keys(file)
    assert robot.id == robot.sha256[:16]
    assert len(robot.sha256) == 64


def test_what_another_process_changes_in_the_file_holds_at_once(file: Path) -> None:
    ring = KeyRing(file)
    assert not ring
    key = add_key(file, "robot", "localize")
    assert ring.caller(key)
    remove_key(file, "robot")
    other = add_key(file, "robut", "localize")
    assert ring.caller(key) is None
    assert ring.caller(other)
    remove_key(file, "robut")
    assert ring.caller(other) is None
    made = ring.add("other", "read", UNLIMITED)
    assert ring.caller(made)
    ring.remove("other")
    assert ring.caller(made) is None


def test_tokens_end_when_their_time_is_over(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [5000.0]
    monkeypatch.setattr(time, "time", lambda: now[0])
    ring = KeyRing(file)
    guest = ring.caller(ring.add("guest", "read", UNLIMITED))
    assert guest
    session, link, free = ring.token(guest, 60), ring.share_token("job", 60, guest), ring.share_token("job", 60, None)
    now[0] += 59.5
    assert ring.bearer(session) == guest
    assert ring.shared_job(link) == ring.shared_job(free) == "job"
    now[0] += 0.5
    assert ring.bearer(session) is ring.shared_job(link) is ring.shared_job(free) is None


def test_a_secret_is_kept_and_one_of_another_length_is_replaced(file: Path, tmp_path: Path) -> None:
    ring = KeyRing(file)
    guest = ring.caller(ring.add("guest", "read", UNLIMITED))
    assert guest
    again, secret = KeyRing(file), tmp_path / "secret"
    secret.write_bytes(b"short")
    ring.keep_sessions(LocalState(secret).secret())
    assert len(secret.read_bytes()) == 32
    token = ring.token(guest, 60)
    assert again.bearer(token) is None
    again.keep_sessions(LocalState(secret).secret())
    assert again.bearer(token)
    assert again.bearer(token[:-1] + ("0" if token[-1] != "0" else "1")) is None
    assert again.viewer_bearer(token) is again.shared_job(token) is None
