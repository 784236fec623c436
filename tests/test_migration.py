"""A data folder that release 0.1.0 wrote is taken over at the start: jobs with status, pose and results; keys.

`tests/data/data_folder_0_1_0` was written by that release (commit 55e20b7), killed while one job ran and one waited:
two localized photos, noise, a sequence of three, a job past its deadline and a cancelled one. `documents.json` has what
its API said of them, `first.jpg` one of the photos as it was sent.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from api_server import assert_problem, create_app, events, finished, serving, settings, until_ready
from stand_ins import make_scene

from service.geometry import look_at
from service.jobs.migrate_0_1 import old_result
from service.jobs.model import JobFilter
from service.jobs.sqlite_store import SqliteJobStore
from service.results import HINTS, Reason
from service.types import GeoAnchor, Pose
from service.web.api_keys import KeyRing
from service.web.key_file import add_key, read_keys, remove_key
from service.web.schemas.conversion import geopose_out, result_out

FOLDER = Path(__file__).with_name("data") / "data_folder_0_1_0"
DOCUMENTS: dict[str, dict[str, Any]] = json.loads((FOLDER / "documents.json").read_text("utf-8"))
BY_NAME = {job["photo"]["name"]: job_id for job_id, job in DOCUMENTS.items()}
KEY = "sfx_aD68AOXS7kVEKse9e0M6K3Js5GoZjuGG72gCa5fdd-0"
"""Of keys.json; it opens nothing else."""
RENAMED = {
    "scene_asked": "requested_scene",
    "region": "prior_region",
    "agreement": "gradient_correlation",
    "considered": "scene_ranking",
    "followed": "tracked",
}
REASONS = {
    "agrees": "verified",
    "render_disagrees": "render_mismatch",
    "little_scene_in_view": "low_coverage",
    "place_uncertain": "position_uncertain",
}
ENDED = [name for name, job_id in BY_NAME.items() if DOCUMENTS[job_id]["finished"]]


def renamed(value: Any) -> Any:
    """Return what 0.1.0's API said in today's names."""
    if isinstance(value, dict):
        if "reason" in value:
            value = value | {"reason": REASONS.get(value["reason"], value["reason"])}
        if "hint" in value and "reason" in value:
            value = value | {"hint": HINTS[Reason(value["reason"])]}
        return {RENAMED.get(name, name): renamed(item) for name, item in value.items()}
    return [renamed(item) for item in value] if isinstance(value, list) else value


def approximately(expected: Any) -> Any:
    """Return the same with numbers that may differ in their last digits: quaternions are computed anew."""
    if isinstance(expected, dict):
        return {name: approximately(item) for name, item in expected.items()}
    if isinstance(expected, list):
        return [approximately(item) for item in expected]
    return pytest.approx(expected, rel=1e-12, abs=1e-12) if isinstance(expected, float) else expected


@pytest.fixture(scope="module")
def taken_over(plugins, tmp_path_factory) -> Iterator[SimpleNamespace]:
    folder = tmp_path_factory.mktemp("old") / "data"
    shutil.copytree(FOLDER, folder)
    keys = KeyRing(folder / "keys.json")
    app = create_app(settings(data_dir=folder, crashes=1), {"studio": make_scene("studio")}, keys)
    with serving(app) as client:
        client.headers["Authorization"] = f"Bearer {KEY}"
        until_ready(client)
        yield SimpleNamespace(client=client, folder=folder)


@pytest.mark.parametrize("name", ENDED)
def test_an_ended_job_is_described_as_before(taken_over, name):
    old = renamed(DOCUMENTS[BY_NAME[name]])
    new = taken_over.client.get(f"/jobs/{BY_NAME[name]}").json()
    # Its records are gone; everything else is there, with the same numbers.
    assert (new.pop("records"), new.pop("stage")) == (0, None)
    del old["records"], old["stage"]
    assert [new.pop(added) for added in ("camera_id", "lens")] == [None, None]
    if new["result"]:
        # The release knew none of these.
        added = ("fitting_intrinsics", "covariance_given_lens", "registered", "right_place", "precise", "asked")
        assert [new["result"].pop(name) for name in added] == [None] * len(added)
        assert [new["result"].pop(name) for name in ("advice", "anchors", "search_summary")] == [[], [], ""]
        assert new["result"]["pose"].pop("frames") == []
        for frame in new["result"]["frames"] or ():
            assert (frame.pop("right_place"), frame.pop("precise")) == (None, None)
    if new["error"]:
        # It gave no hint; today every error has one.
        assert old["error"].pop("hint") == ""
        assert new["error"].pop("hint")
    assert new == approximately(old)


def test_poses_of_results_and_of_frames_are_exactly_the_same(taken_over):
    for name in ("photo_00.jpg", "photo_01.jpg", "0.jpg and 2 more"):
        old = DOCUMENTS[BY_NAME[name]]["result"]
        new = taken_over.client.get(f"/jobs/{BY_NAME[name]}").json()["result"]
        assert new["status"] == "localized"
        assert new["pose"]["world_from_camera"]["matrix"] == old["pose"]["world_from_camera"]["matrix"]
        for before, after in zip(old["frames"] or (), new["frames"] or (), strict=True):
            assert after["world_from_camera"]["matrix"] == before["world_from_camera"]["matrix"]
    assert len(new["frames"]) == 3


def test_lists_traces_streams_photos_and_exports_go_on(taken_over):
    client, kept = taken_over.client, BY_NAME["photo_00.jpg"]
    assert {job["id"] for job in client.get("/jobs").json()["jobs"]} == set(DOCUMENTS)
    listed = [job["id"] for job in client.get("/jobs?status=localized").json()["jobs"]]
    assert sorted(listed) == sorted(BY_NAME[n] for n in ("photo_00.jpg", "photo_01.jpg", "0.jpg and 2 more"))
    assert client.get(f"/jobs/{kept}/trace").json()["records"] == []
    assert [name for name, _, _ in events(client.get(f"/jobs/{kept}/events").text)] == ["result"]
    assert client.get(f"/jobs/{kept}/photo").content == (FOLDER / "photos" / f"{kept}.jpg").read_bytes()
    position = DOCUMENTS[kept]["result"]["pose"]["position"]
    exported = [float(word) for word in client.get(f"/jobs/{kept}/export/tum").text.split()]
    assert exported[1:4] == position
    walk = client.get(f"/jobs/{BY_NAME['0.jpg and 2 more']}/export/tum").text.splitlines()
    frames = DOCUMENTS[BY_NAME["0.jpg and 2 more"]]["result"]["frames"]
    assert [float(line.split()[0]) for line in walk] == [f["time_s"] for f in frames if f["status"] == "localized"]
    assert walk


def test_what_waited_is_done_and_what_ran_is_counted_as_lost(taken_over):
    waiting = finished(taken_over.client, f"/jobs/{BY_NAME['waiting.jpg']}")
    assert (waiting["state"], waiting["attempt"], waiting["options"]) == ("succeeded", 1, {"candidates": 3})
    assert waiting["result"]["intrinsics_source"] == "given"
    running = taken_over.client.get(f"/jobs/{BY_NAME['long.jpg']}").json()
    assert (running["state"], running["attempt"], running["error"]["code"]) == ("interrupted", 1, "interrupted")


def test_keys_stay(taken_over):
    client = taken_over.client
    assert client.post("/tokens").status_code == 200
    assert_problem(client.get("/jobs", headers={"Authorization": "Bearer sfx_other"}), 401, "unauthorized")
    # And whose job it is: the same request with the same key is no new job.
    sent = {"files": {"photo": (FOLDER / "first.jpg").read_bytes()}, "data": {"keep_photo": "true"}}
    again = client.post("/localize", **sent, headers={"Idempotency-Key": "first"}).json()
    assert again["id"] == BY_NAME["photo_00.jpg"]


def test_a_key_has_its_jobs_of_before_and_a_later_one_of_its_name_has_none(tmp_path):
    """A release that kept the key's name alone kept no time of keys either."""
    shutil.copytree(FOLDER, tmp_path / "data")
    file = tmp_path / "data" / "keys.json"
    (name,) = [key.name for key in read_keys(file)]

    def seen(ring: KeyRing) -> int:
        store = SqliteJobStore(tmp_path / "data" / "jobs.sqlite")
        for by_name, client in ring.unnamed_clients():
            store.reassign(by_name, client)
        of = next(key for key, _ in ring.listed())
        found = store.page(JobFilter(client=f"key:{name}:{of.id}"), 100)
        store.close()
        return len(found)

    kept = file.read_bytes()
    remove_key(file, name)
    add_key(file, name, "read")
    assert seen(KeyRing(file)) == 0
    file.write_bytes(kept)
    assert seen(KeyRing(file)) == len(DOCUMENTS)


def test_a_second_start_finds_it_done(tmp_path):
    shutil.copytree(FOLDER, tmp_path / "data")
    for _ in range(2):
        store = SqliteJobStore(tmp_path / "data" / "jobs.sqlite")
        assert store.ids() == set(DOCUMENTS)
        assert store.result(BY_NAME["photo_00.jpg"])
        store.close()


def test_a_migration_that_fails_changes_nothing(tmp_path):
    shutil.copytree(FOLDER, tmp_path / "data")
    path = tmp_path / "data" / "jobs.sqlite"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE jobs SET photo = 'torn' WHERE id = ?", (BY_NAME["noise.jpg"],))
    with pytest.raises(ValueError, match="Expecting value"):
        SqliteJobStore(path)
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (1,)
        assert database.execute("SELECT count(fields) FROM jobs").fetchone() == (len(DOCUMENTS),)
        assert database.execute("SELECT count(*) > 0 FROM events").fetchone() == (1,)


def test_a_place_on_earth_and_other_answers_stay():
    old = DOCUMENTS[BY_NAME["photo_01.jpg"]]["result"]
    pose = Pose(np.array(old["pose"]["world_from_camera"]["matrix"]))
    enu_from_world = 2.5 * look_at(np.zeros(3), np.array([1.0, 2, 3]), np.array([0, 0, 1.0])).world_from_camera
    enu_from_world[3] = 0, 0, 0, 1
    geopose = geopose_out(GeoAnchor(48.1, 11.5, 500.0, enu_from_world), pose).model_dump()
    other = {"probability": 0.25, "pose": old["pose"]}
    told = result_out(old_result(json.dumps(old | {"geopose": geopose, "alternatives": [other]})))
    assert told.geopose
    after = told.geopose.model_dump()
    assert after["quaternion"] == approximately(geopose["quaternion"])
    # Through the earth's centre and back: some nanometres.
    assert after["position"] == pytest.approx(geopose["position"], abs=1e-7, rel=0)
    assert [(a.probability, a.pose.position) for a in told.alternatives] == [(0.25, old["pose"]["position"])]


def test_every_reason_of_the_release_is_known():
    old = DOCUMENTS[BY_NAME["photo_01.jpg"]]["result"]
    reasons = (
        "agrees few_features no_matching_view render_disagrees few_inliers little_scene_in_view focal_uncertain "
        "intrinsics_contradicted place_uncertain outside_prior ambiguous mirrored budget_exhausted"
    )
    for reason in reasons.split():
        verdict = old_result(json.dumps(old | {"reason": reason})).estimate.verdict
        assert verdict.reason == REASONS.get(reason, reason)
