"""A building of many rooms that are alike: every camera has a view nearby, and scores by words rank as exact ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service import loaded_scene
from service.geometry import look_at
from service.interfaces import Features
from service.loaded_scene import LoadedScene
from service.pose.features.in_plane_rotation import Corners
from service.pose.features.rendered_views import View
from service.pose.retrieval import inverted_views
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.inverted_views import INVERTED, InvertedViews, view_scores
from service.pose.retrieval.scores import ScoreConfig, retrieval_scores, top_indices
from service.pose.retrieval.viewpoints import VIEWPOINTS, choose_spread_poses
from service.types import Camera, Intrinsics

ROOMS, CAMERAS = 60, 20
LENS = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)


def unit(x: np.ndarray) -> np.ndarray:
    return (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32)


def building(rng: np.random.Generator) -> tuple[list[View], np.ndarray, np.ndarray]:
    """Return views of rooms with the same furniture, the furniture's features, and six of each room's pictures."""
    furniture, pictures = unit(rng.normal(size=(120, 32))), unit(rng.normal(size=(ROOMS, 6, 32)))
    views = []
    for number in range(ROOMS * CAMERAS):
        seen = furniture[rng.permutation(120)[:34]] + 0.05 * rng.normal(size=(34, 32))
        own = pictures[number // CAMERAS] + 0.05 * rng.normal(size=(6, 32))
        angle, x = rng.uniform(0, 2 * np.pi), 10.0 * (number // CAMERAS)
        position = np.array([x + rng.uniform(-3, 3), rng.uniform(-2, 2), 1.5])
        pose = look_at(position, position + np.array([np.cos(angle), np.sin(angle), 0]), np.array([0, 0, 1.0]))
        features = Features(np.zeros((40, 2), np.float32), np.ones(40, np.float32), unit(np.concatenate([own, seen])))
        views.append(View(Camera(LENS, pose), features, np.zeros((40, 3), np.float32)))
    return views, furniture, pictures


def test_scores_by_words_find_the_room_as_exact_ones_do() -> None:
    rng = np.random.default_rng(0)
    views, furniture, pictures = building(rng)
    words = InvertedViews.of_many(views)
    assert words is not None
    assert InvertedViews.of_many(views[: INVERTED.min_views - 1]) is None  # faster one by one
    descriptors = [view.features.descriptors for view in views]
    for room in (0, 31, 59):
        photo = unit(np.concatenate([furniture, pictures[room]]) + 0.05 * rng.normal(size=(126, 32)))
        exact, found = retrieval_scores(photo, descriptors), view_scores(photo, views, words)
        # All of a room's views show its pictures, and no other view does.
        assert set(top_indices(found, 10) // CAMERAS) == {room}
        assert set(top_indices(exact, 10) // CAMERAS) == {room}
        in_room = slice(room * CAMERAS, (room + 1) * CAMERAS)
        # Seen: 0.93 to 0.96 of the exact scores, since words miss some features.
        assert found[in_room].mean() == pytest.approx(exact[in_room].mean(), rel=0.2)
    assert not view_scores(np.zeros((0, 32), np.float32), views, words).any()


def test_as_many_words_views_and_bits_are_used_as_said(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    for count, words in ((600 * 17, 17), (600 * 17 - 1, 16), (900, 16)):
        found = InvertedViews.of([unit(rng.normal(size=(count, 4)))], ScoreConfig(view_features=count))
        assert len(found.words) == words
        assert len(found.entries) == count
        assert np.allclose(np.linalg.norm(found.words, axis=1), 1, atol=1e-5)
    # A word is looked for in a sample of forty descriptors for each.
    sampled: list[int] = []
    nearest = inverted_views._nearest
    monkeypatch.setattr(
        inverted_views, "_nearest", lambda some, words: sampled.append(len(some)) or nearest(some, words)
    )
    inverted_views._words(unit(rng.normal(size=(600 * 17, 4))), INVERTED)
    assert sampled == [40 * 17] * 4
    steps = np.float32([[0.5, -0.5, 0.705, 0.71], [-0.705, -0.71, 0.0, 1 / 360 + 1e-4]])
    assert inverted_views._quantized(steps).tolist() == [[90, -90, 127, 127], [-127, -127, 0, 1]]
    looked_up: list[tuple[int, int]] = []
    highest, similarities = inverted_views._highest, inverted_views.best_similarities
    monkeypatch.setattr(
        inverted_views,
        "_highest",
        lambda values, count: looked_up.append((len(values), count)) or highest(values, count),
    )
    monkeypatch.setattr(
        inverted_views,
        "best_similarities",
        lambda photo, views, scores: looked_up.append((len(photo), len(views))) or similarities(photo, views, scores),
    )
    views = [unit(rng.normal(size=(5, 4))) for _ in range(40)]
    InvertedViews.of(views).scores(unit(rng.normal(size=(200, 4))), views)
    # The photo's strongest 150 features, in the four nearest words each; the best 32 views exactly.
    assert looked_up == [(150, 4), (150, 32)]


def test_words_are_the_same_from_their_arrays() -> None:
    words = InvertedViews.of_many(building(np.random.default_rng(0))[0])
    assert words is not None
    stored = InvertedViews.from_arrays({"other": np.zeros(1), **words.arrays()})
    assert stored is not None
    assert all(np.array_equal(a, b) for a, b in zip(stored.arrays().values(), words.arrays().values(), strict=True))
    assert InvertedViews.from_arrays({"other": np.zeros(1)}) is None


def test_every_camera_of_a_large_building_has_a_view_nearby() -> None:
    """512 views leave cameras of most rooms without one."""
    poses = [view.camera.pose for view in building(np.random.default_rng(0))[0]]
    places = np.concatenate([[p.position_in_world / 3 for p in poses], [p.axis_in_world for p in poses]], 1)

    def farthest(most: int) -> float:
        chosen = choose_spread_poses(poses, 3.0, replace(VIEWPOINTS, max_views=most))
        return max(np.linalg.norm(places[chosen] - place, axis=1).min() for place in places)

    assert farthest(VIEWPOINTS.max_views) < VIEWPOINTS.spacing < farthest(512)


def test_a_scene_says_that_its_index_was_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    few = replace(VIEWPOINTS, max_views=7)
    assert [few.cuts(7, 8), few.cuts(7, 7), few.cuts(6, 8), few.cuts(7, 0)] == [True, False, False, False]
    monkeypatch.setattr(loaded_scene, "release", lambda _: None)
    views = tuple(building(np.random.default_rng(0))[0][:7])
    none = Corners(np.zeros(0, np.float32), np.zeros((0, 32), np.uint8))
    indexes = [ViewIndex(views, none, is_cut=is_cut) for is_cut in (True, False)]
    estimator = SimpleNamespace(prepare=lambda *_: indexes.pop(0))
    monkeypatch.setattr(loaded_scene.ESTIMATORS, "load", lambda _: estimator)
    scenes = [LoadedScene(*[SimpleNamespace()] * 3) for _ in indexes]  # type: ignore[arg-type]
    for scene in scenes:
        scene.prepare("view_index")
    assert ["the 7 views" in " ".join(scene.warnings) for scene in scenes] == [True, False]
