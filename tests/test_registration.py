"""Registration: planted similarities, with noise and a gross outlier; what can't be determined; the file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from register_run import errors, row
from registration_layouts import UP, evidence, layout, planted

from service.errors import CorruptScene, RegistrationFailed, RegistrationNotFound, StorageFailed
from service.geometry import look_at, so3_exp
from service.registration.consensus import CONSENSUS, _starts
from service.registration.observations import Direction, Evidence, Height, Length, Observation
from service.registration.quantiles import chi_square_quantile, f_quantile
from service.registration.register import register
from service.registration.registration import PARTS, Origin, Registration
from service.registration.registration_file import FILE, KEPT, RegistrationFile
from service.types import Pose


def registered(known: Evidence) -> Registration:
    return register(known, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("kind", "what", "count"),
    [("around", "positions", 8), ("around", "poses", 8), ("around", "drift", 8), ("walk", "gps", 12)],
)
def test_an_outlier_is_found_and_costs_nothing(kind, what, count):
    """tests/register_run.py has 50 seeds; docs/registration.md their figures."""
    mine, ideal, inside, rejected, complete = row(kind, what, count, 2)
    assert complete == 1
    assert np.all(mine <= 1.3 * ideal)
    assert inside >= 0.5  # of 2, where 95 % are right
    assert rejected[0] == 0


def test_quantiles_are_those_of_tables():
    # Abramowitz and Stegun, tables 26.8 and 26.9.
    assert chi_square_quantile(0.95, 7) == pytest.approx(14.067, abs=1e-3)
    assert chi_square_quantile(0.999, 3) == pytest.approx(16.266, abs=1e-3)
    assert f_quantile(0.95, 7, 2) == pytest.approx(19.353, abs=1e-3)
    assert f_quantile(0.99, 3, 14) == pytest.approx(5.564, abs=1e-3)


def test_exact_places_give_the_planted_similarity():
    rng = np.random.default_rng(3)
    truth, places = planted(rng), layout("around", 6, rng)
    inverse = np.linalg.inv(truth.matrix)
    seen = [Observation(f"p{i}", (inverse @ [*p, 1.0])[:3], p) for i, p in enumerate(places)]
    found = registered(Evidence(seen))
    assert found.target_from_world == pytest.approx(truth.matrix, rel=1e-6, abs=1e-6)
    assert found.metres_per_unit == pytest.approx(truth.scale, rel=1e-9)
    assert all(r.used and r.metres < 1e-6 for r in found.residuals)
    assert not found.warnings


@pytest.mark.parametrize("told", ["a pose and a place", "two places and up", "three places"])
def test_every_minimal_sample_of_exact_observations_gives_the_planted_similarity(told):
    rng = np.random.default_rng(9)
    truth = planted(rng)
    inverse = np.linalg.inv(truth.matrix)
    seen = [Observation(f"p{i}", (inverse @ [*p, 1.0])[:3], p) for i, p in enumerate(layout("around", 4, rng))]
    up = [Direction(truth.rotation.T @ UP, UP, 0.01)] if told == "two places and up" else []
    if told == "a pose and a place":
        camera = look_at(seen[0].position_in_world, np.zeros(3), UP).world_from_camera[:3, :3]
        seen[0] = replace(seen[0], world_from_camera=camera, target_from_camera=truth.rotation @ camera)
    # The first start is that of all together.
    _, *samples = _starts(Evidence(seen, directions=up), rng, CONSENSUS)
    assert len(samples) >= 3
    for sample in samples:
        assert sample.matrix == pytest.approx(truth.matrix, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("kind", ["line", "place"])
def test_what_a_line_or_one_place_leaves_open_is_said(kind):
    rng = np.random.default_rng(1)
    known = evidence(kind, "positions", 8, rng)[1]
    if kind == "place":
        with pytest.raises(RegistrationFailed, match="all 7 places coincide within their noise"):
            registered(known)
        return
    found = registered(known)
    assert found.determined == ("scale",)
    assert "lie on one line" in found.reason
    assert found.placed(Pose(np.eye(4)), None) is None
    assert found.metres_per_unit == pytest.approx(registered(replace(known, directions=[])).metres_per_unit, rel=1e-9)


def test_a_line_with_a_known_up_determines_everything():
    rng = np.random.default_rng(2)
    _, known, truth = evidence("line", "positions", 8, rng)
    up = Direction(truth.rotation.T @ UP, UP, np.radians(1.0))
    found = registered(replace(known, directions=[up]))
    assert found.is_complete
    error = errors(found.target_from_world, found.centre_in_world, truth)
    assert np.degrees(np.linalg.norm(error[:3])) < 2  # seen: 0.4


def test_poses_in_one_place_tell_the_rotation_alone():
    rng = np.random.default_rng(4)
    _, known, truth = evidence("place", "poses", 6, rng)
    found = registered(known)
    assert found.determined == ("up", "heading")
    assert "all 5 places coincide within their noise" in found.reason
    rotation = found.target_from_world[:3, :3] / found.scale
    assert rotation == pytest.approx(truth.rotation, abs=0.02)


def test_a_length_and_a_floor_tell_scale_and_up():
    rng = np.random.default_rng(5)
    truth = planted(rng)
    inverse = np.linalg.inv(truth.matrix)
    a, b = ((inverse @ [*p, 1.0])[:3] for p in ([0.0, 0, 0], [2.0, 0, 0]))
    up = Direction(truth.rotation.T @ UP, UP, 0.01)
    known = Evidence(directions=[up], lengths=[Length(a, b, 2.0, 0.02)], heights=[Height(a, 0.0, 0.01)], up=(0, 0, 1))
    found = registered(known)
    assert found.determined == ("scale", "up")
    assert found.metres_per_unit == pytest.approx(truth.scale, rel=1e-6)
    assert found.metres_per_unit_sigma == pytest.approx(0.01 * truth.scale, rel=0.01)
    assert found.up_in_world == pytest.approx(truth.rotation.T @ UP, abs=1e-6)


def test_a_scale_that_is_certain_is_kept():
    rng = np.random.default_rng(6)
    _, known, truth = evidence("around", "positions", 8, rng)
    found = registered(replace(known, metres_per_unit=truth.scale))
    assert found.metres_per_unit == pytest.approx(truth.scale, rel=1e-12)
    assert found.metres_per_unit_sigma == 0


def test_headings_turn_a_scene_whose_up_is_known():
    rng = np.random.default_rng(7)
    truth = planted(rng)
    inverse = np.linalg.inv(truth.matrix)
    seen = []
    for i in range(8):
        azimuth = rng.uniform(0, 2 * np.pi)
        camera = look_at(np.zeros(3), np.array([np.sin(azimuth), np.cos(azimuth), rng.uniform(-0.3, 0.3)]), UP)
        place = (inverse @ [0.0, 0.0, 0.0, 1.0])[:3]
        rotation = truth.rotation.T @ camera.world_from_camera[:3, :3]
        seen.append(Observation(f"p{i}", place, np.zeros(3), np.eye(3), rotation, heading=azimuth, heading_sigma=0.1))
    up = Direction(truth.rotation.T @ UP, UP, 0.01)
    found = registered(Evidence(seen, directions=[up], up=(0, 0, 1), metres_per_unit=truth.scale))
    assert found.is_complete
    assert found.target_from_world[:3, :3] == pytest.approx(truth.scale * truth.rotation, rel=1e-3, abs=1e-3)


def test_photos_that_were_turned_after_their_poses_are_turned_back():
    rng = np.random.default_rng(8)
    _, known, truth = evidence("around", "poses", 8, rng)
    back = so3_exp(np.array([0, 0, np.pi / 2]))
    turned = [replace(o, target_from_camera=o.target_from_camera @ back) for o in known.observations]
    found = registered(replace(known, observations=turned, may_be_turned=True))
    assert "turned by 90 degrees clockwise" in found.warnings[0]
    assert found.target_from_world[:3, :3] / found.scale == pytest.approx(truth.rotation, abs=0.02)


def test_left_handed_coordinates_are_refused():
    known = evidence("around", "positions", 9, np.random.default_rng(9))[1]
    mirrored = [replace(o, position=o.position * [1, 1, -1]) for o in known.observations]
    with pytest.raises(RegistrationFailed, match="mirrored"):
        registered(replace(known, observations=mirrored))


def test_nothing_is_no_registration():
    with pytest.raises(RegistrationFailed, match="no places"):
        registered(Evidence())


def test_the_covariance_of_a_placed_pose_is_that_of_its_parts():
    """Against samples of the similarity and of the pose."""
    rng = np.random.default_rng(10)
    truth = planted(rng)
    spread = np.diag([0.01, 0.02, 0.015, 0.1, 0.05, 0.08, 0.02])
    registration = Registration(truth.matrix, np.array([0.3, -0.2, 0.1]), spread**2, PARTS, "")
    pose = look_at(np.array([1.0, 2.0, 0.5]), np.zeros(3), UP)
    own = np.diag([0.01, 0.01, 0.02, 0.03, 0.02, 0.01]) ** 2
    placed = registration.placed(pose, own)
    about = truth.about(registration.centre_in_world)
    samples = []
    for _ in range(4000):
        moved = about.moved(spread @ rng.normal(size=7))
        twist = np.linalg.cholesky(own) @ rng.normal(size=6)
        at = pose.world_from_camera @ np.array([*twist[3:], 1.0])
        samples.append((moved.matrix @ at)[:3])
    assert np.cov(np.array(samples).T) == pytest.approx(placed.position_covariance, rel=0.2, abs=2e-4 * truth.scale**2)
    assert placed.pose.position_in_world == pytest.approx((truth.matrix @ [1, 2, 0.5, 1])[:3])


def test_a_registration_by_another_scene_has_the_uncertainty_of_both():
    """Against samples: a point of the scene goes to the other scene's world, and from there to its target."""
    rng = np.random.default_rng(12)
    first, second = planted(rng), planted(rng)
    spread = np.diag([0.01, 0.02, 0.015, 0.1, 0.05, 0.08, 0.02])
    inner = Registration(first.matrix, np.array([0.3, -0.2, 0.1]), spread**2, PARTS, "")
    other = Registration(second.matrix, np.array([1.0, 0.5, -1.0]), 0.25 * spread**2, PARTS, "", origin=Origin(1, 2, 3))
    both = inner.onto(other)
    assert both.target_from_world == pytest.approx(second.matrix @ first.matrix)
    assert both.origin == other.origin
    point = np.array([1.0, 2.0, 0.5])
    samples = []
    for _ in range(4000):
        moved = first.about(inner.centre_in_world).moved(spread @ rng.normal(size=7)).matrix
        onto = second.about(other.centre_in_world).moved(0.5 * spread @ rng.normal(size=7)).matrix
        samples.append((onto @ moved @ [*point, 1.0])[:3])
    placed = both.placed(look_at(point, np.zeros(3), UP), None)
    expected = np.cov(np.array(samples).T)
    assert placed.position_covariance == pytest.approx(expected, rel=0.2, abs=0.03 * np.trace(expected))


def test_the_worked_example_prints_what_the_page_says(capsys):
    text = (Path(__file__).parents[1] / "docs" / "registration.md").read_text("utf-8")
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), {})
    assert f"```text\n{capsys.readouterr().out}```" in text


def complete() -> Registration:
    return registered(evidence("around", "positions", 8, np.random.default_rng(11))[1])


def test_revisions_are_kept_undone_and_never_numbered_twice(tmp_path):
    file, found = RegistrationFile(tmp_path), complete()
    assert file.current() is None
    with pytest.raises(RegistrationNotFound):
        file.undo()
    first = file.add(replace(found, origin=Origin(47.0, 8.0, 400.0), source="a"))
    second = file.add(found)
    assert (first.revision, second.revision) == (1, 2)
    assert (tmp_path / FILE).is_file()
    assert file.undo().source == "a"
    current = RegistrationFile(tmp_path).current()
    assert current.revision == 1
    assert current.geo_anchor.latitude_deg == 47.0
    assert np.array_equal(current.target_from_world, first.target_from_world)
    assert file.add(found).revision == 3
    for _ in range(KEPT):
        file.add(found)
    assert len(file.history().revisions) == KEPT


def test_a_scene_that_cannot_be_written_beside_is_registered_in_the_data_folder(tmp_path):
    (tmp_path / "scenes").write_text("no folder")
    scene = tmp_path / "scenes" / "hall.ply"
    with pytest.raises(StorageFailed):
        RegistrationFile(scene).add(complete())
    file = RegistrationFile(scene, tmp_path / "data")
    file.add(complete())
    assert file.path.is_relative_to(tmp_path / "data")
    assert file.current().revision == 1


def test_a_damaged_file_is_an_error_with_its_name(tmp_path):
    (tmp_path / FILE).write_text('{"version": 1, "value": {"revisions": 3}}')
    with pytest.raises(CorruptScene, match=FILE):
        RegistrationFile(tmp_path).current()
