"""A mirrored photo is told from one that isn't, also where the scene is nearly its own mirror image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rest_in_ci import rest_in_ci
from small_room import write_room
from test_estimators import LENS, assert_near, photo_at, unseen_pose

from service.device_readings import DeviceReadings, Gravity
from service.estimators.search_config import SEARCH
from service.geometry import moved, project, transformed
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.pose.features.mirrored_query import mirrored_query
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.results import Reason, Status
from service.types import BoxPrior, Pose, Query

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def symmetric(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    folder = tmp_path_factory.mktemp("symmetric") / "room"
    return LoadedScene.load(write_room(folder, symmetric=True), cache_dir=scene_cache)


@pytest.mark.parametrize("seed", rest_in_ci(0, 1, 2))
def test_a_mirrored_photo_of_a_symmetric_room_is_not_localized(seed: int, symmetric: LoadedScene) -> None:
    truth = unseen_pose(seed)
    photo = photo_at(symmetric, truth)
    found = localize(photo, symmetric)
    assert found.verdict.status is Status.LOCALIZED
    assert_near(found.pose, truth)
    # It fits beyond doubt: gradients correlate by 0.9991 (seen), a mirrored photo's by less than 0.986.
    assert "check_mirror" not in [record.stage for record in found.records]
    found = localize(mirrored_query(photo), symmetric)
    assert found.verdict.status is Status.UNCERTAIN
    assert found.verdict.reason is Reason.MIRRORED
    assert "check_mirror" in [record.stage for record in found.records]


def test_a_mirrored_photo_is_told_also_where_the_gate_does_not_believe_it_anyway(
    symmetric: LoadedScene,
) -> None:
    stricter = replace(SHIPPED_MODEL, floors={**SHIPPED_MODEL.floors, "colours": 0.992})
    config = replace(SEARCH, verification=replace(SEARCH.verification, model=stricter))
    photo = photo_at(symmetric, unseen_pose())
    assert localize(photo, symmetric, Request(config=config)).verdict.status is Status.LOCALIZED
    verdict = localize(mirrored_query(photo), symmetric, Request(config=config)).verdict
    assert verdict.signals["colours"] < 0.992
    assert (verdict.status, verdict.reason) == (Status.UNCERTAIN, Reason.MIRRORED)


def test_a_mirror_image_in_another_place_has_to_fit_much_better(symmetric: LoadedScene) -> None:
    """Rooms that are mirror images of others are more frequent than mirrored photos."""
    elsewhere = replace(SEARCH, mirror=replace(SEARCH.mirror, same_place=0.0))
    photo = mirrored_query(photo_at(symmetric, unseen_pose()))
    # Dissimilarity of the blurred photo's mirror image, relative to the answer's: 0.48 (seen); of the sharp one's 0.03.
    blurred = replace(photo, rgb=cv2.GaussianBlur(photo.rgb, (0, 0), 2.0))
    for sent, config, reason in (
        (blurred, SEARCH, Reason.MIRRORED),
        (blurred, elsewhere, Reason.VERIFIED),
        (photo, elsewhere, Reason.MIRRORED),
    ):
        assert localize(sent, symmetric, Request(config=config)).verdict.reason is reason


def test_a_noisy_photo_is_looked_for_both_ways_and_found(symmetric: LoadedScene) -> None:
    truth = unseen_pose()
    photo = photo_at(symmetric, truth)
    noise = np.random.default_rng(0).normal(0, 25, photo.rgb.shape)
    found = localize(replace(photo, rgb=np.clip(photo.rgb + noise, 0, 255).astype(np.uint8)), symmetric)
    assert found.verdict.status is Status.LOCALIZED
    assert "check_mirror" in [record.stage for record in found.records]
    assert_near(found.pose, truth)


def test_a_region_that_excludes_the_mirrored_place_changes_nothing(symmetric: LoadedScene) -> None:
    """It is of the photo as it was sent."""
    truth = unseen_pose()
    there = (MIRROR @ truth.world_from_camera @ MIRROR)[:3, 3]
    query = replace(mirrored_query(photo_at(symmetric, truth)), region=BoxPrior(there - 0.2, there + 0.2))
    assert localize(query, symmetric).verdict.reason is Reason.MIRRORED


@pytest.mark.ci
def test_gravity_of_a_rolled_camera_tells_whether_its_photo_is_mirrored(symmetric: LoadedScene) -> None:
    """Measured in the camera: mirroring the photo afterwards rolls what it shows to the other side."""
    truth = moved(unseen_pose(), np.array([0, 0, 0.4, 0, 0, 0]))
    info = replace(symmetric.scene.info, up_in_world=(0.0, 0.0, 1.0))
    upright = replace(symmetric, scene=replace(symmetric.scene, info=info))
    mirrored = mirrored_query(photo_at(upright, truth))
    x, y, z = truth.world_from_camera[2, :3].tolist()
    for up, is_mirrored in (((x, y, z), True), ((-x, y, z), False)):
        found = localize(replace(mirrored, readings=DeviceReadings(gravity=Gravity(up))), upright)
        assert (found.verdict.reason is Reason.MIRRORED) is is_mirrored


@pytest.mark.parametrize("kind", ["symmetric", *rest_in_ci("repeated", "ordinary")])
def test_the_index_knows_what_a_scene_is_like(kind: str, tmp_path: Path, scene_cache: Path) -> None:
    """Turned by a half a repeated room is the same, but not in a mirror; a symmetric one the other way round."""
    room = write_room(tmp_path / "room", repeated=kind == "repeated", symmetric=kind == "symmetric")
    for _ in range(2):  # the second reads what the first has stored
        index = LoadedScene.load(room, cache_dir=scene_cache).prepare("view_index")
        assert index.repeats_itself == (kind == "repeated")
        assert index.like_its_mirror_image == (kind == "symmetric")


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 1000), st.floats(0.3, 0.7))
def test_mirroring_moves_what_is_seen_to_the_other_side(seed: int, centre: float) -> None:
    """Seen by the mirrored camera, mirrored points are where the mirrored photo has them."""
    rng = np.random.default_rng(seed)
    lens = replace(LENS, cx=centre * LENS.width)
    photo = Query(rng.integers(0, 255, (LENS.height, LENS.width, 3)).astype(np.uint8), lens, "given", lens)
    other = mirrored_query(photo)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (5, 3))
    camera_from_world = Pose(np.eye(4)).camera_from_world
    seen = project(transformed(camera_from_world, points), lens)
    there = project(transformed(MIRROR @ camera_from_world, points), other.intrinsics)
    assert np.allclose(there[:, 0], lens.width - seen[:, 0])
    assert np.allclose(there[:, 1], seen[:, 1])
    assert np.array_equal(other.rgb[:, 0], photo.rgb[:, -1])
    assert np.array_equal(mirrored_query(other).rgb, photo.rgb)
    assert mirrored_query(other).intrinsics.cx == pytest.approx(lens.cx)
