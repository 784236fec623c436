"""The parts of a registration: residuals beside finite differences, starts that are exact, bounds by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.errors import RegistrationFailed
from service.geometry import look_at, so3_exp
from service.registration import determinacy, register
from service.registration.consensus import (
    CONSENSUS,
    _facing,
    _mean_rotation,
    _of_all,
    _scaled,
    _subsets,
    _upright,
    free_parameters,
    turning,
    umeyama,
)
from service.registration.observations import Direction, Evidence, Height, Length, Observation
from service.registration.similarity_fit import (
    Noise,
    Similarity,
    _drift_covariance,
    _rows,
    fit_similarity,
    is_stated,
    observation_rows,
    unknown_noise,
)

UP = np.array([0.0, 0.0, 1.0])
TRUTH = Similarity(so3_exp(np.array([0.3, -0.4, 0.9])), 1.7, np.array([5.0, -3.0, 2.0]), np.array([0.4, 0.1, -0.2]))
CAMERA = so3_exp(np.array([0.2, 1.1, -0.3]))
NOISE = Noise(0.1, 0.03, {"position": 2.0, "rotation": 3.0, "heading": 1.5})


def onto(similarity: Similarity, point: np.ndarray) -> np.ndarray:
    return similarity.scale * similarity.rotation @ (point - similarity.centre_in_world) + similarity.shift


def seen_at(point: list[float], offset: float = 0.0, **known: Any) -> Observation:
    place = np.array(point)
    return Observation("p", place, onto(TRUTH, place) + offset, **known)


def derivative(rows_at: Any) -> list[np.ndarray]:
    """Of each block's residual by the seven parameters, by central differences."""
    steps = 1e-6 * np.eye(7)
    ends = [
        ([r.residual for r in rows_at(TRUTH.moved(s))], [r.residual for r in rows_at(TRUTH.moved(-s))]) for s in steps
    ]
    return [np.stack([(one[n] - other[n]) / 2e-6 for one, other in ends], 1) for n in range(len(ends[0][0]))]


# ------------------------------------------------------------------ residuals


def full_observation() -> Observation:
    """Off by a decimetre and a few degrees, in all that can be known."""
    half = np.random.default_rng(1).normal(0, 0.05, (6, 8))
    turned = TRUTH.rotation @ CAMERA
    return seen_at(
        [1.0, 2.0, 0.5], 0.1, world_from_camera=CAMERA, target_from_camera=so3_exp(np.full(3, 0.02)) @ turned,
        heading=float(np.arctan2(turned[0, 2], turned[1, 2])) - 0.2, heading_sigma=0.1,
        localization_covariance=half @ half.T,
    )  # fmt: skip


def test_an_observations_residuals_are_what_they_say_with_their_derivatives_and_covariances() -> None:
    seen = full_observation()
    rows = list(observation_rows(seen, 4, TRUTH, NOISE))
    assert [(row.kind, row.owner) for row in rows] == [("position", 4), ("rotation", 4), ("heading", 4)]
    position, rotation, heading = rows
    assert np.allclose(position.residual, -0.1)
    assert np.allclose(rotation.residual, -0.02, atol=1e-3)
    assert heading.residual == pytest.approx([0.2])
    for row, numeric in zip(rows, derivative(lambda s: observation_rows(seen, 4, s, NOISE)), strict=True):
        # The logarithm of a rotation is linear about the identity: exact where its angle is 0.
        assert np.allclose(row.jacobian, numeric, atol=0.05 if row.kind == "rotation" else 1e-5)
    moves, turns = seen.localization_covariance[3:, 3:], seen.localization_covariance[:3, :3]
    both = TRUTH.rotation @ CAMERA
    own = 1.7**2 * both @ moves @ both.T
    assert np.allclose(position.covariance, 0.2**2 * np.eye(3) + own)
    assert position.localized_share == pytest.approx(np.trace(own) / (np.trace(own) + 3 * 0.2**2))
    assert np.allclose(rotation.covariance, 0.09**2 * np.eye(3) + both @ turns @ both.T)
    level = np.hypot(*both[:2, 2])
    assert heading.covariance == pytest.approx(np.array([[(0.15 / level) ** 2]]))
    stated = replace(seen, position_covariance=np.diag([1.0, 2, 3]), rotation_sigma=0.5)
    position, rotation, _ = observation_rows(stated, 4, TRUTH, NOISE)
    assert np.allclose(position.covariance, 4 * np.diag([1.0, 2, 3]) + own)
    assert np.allclose(rotation.covariance, 1.5**2 * np.eye(3) + both @ turns @ both.T)


def test_headings_differ_by_the_short_way_round() -> None:
    seen = full_observation()
    for turns in (-1, 1):
        around = replace(seen, heading=seen.heading + turns * 2 * np.pi)
        assert list(observation_rows(around, 0, TRUTH, NOISE))[2].residual == pytest.approx([0.2])
    opposite = replace(seen, heading=seen.heading + 0.2 + np.pi - 0.01)
    assert list(observation_rows(opposite, 0, TRUTH, NOISE))[2].residual == pytest.approx([-np.pi + 0.01])


def test_what_is_known_of_the_whole_scene_has_residuals_too() -> None:
    """A direction off by an angle, a length and a height."""
    up = TRUTH.rotation.T @ UP
    off = so3_exp(np.array([0.3, 0.0, 0.0])) @ UP
    known = Evidence(
        directions=[Direction(up, off, 0.05)],
        lengths=[Length(np.zeros(3), np.array([0.0, 2.0, 0.0]), 3.0, 0.06)],
        heights=[Height(np.array([1.0, 0.5, -0.3]), 1.0, 0.02)],
        up=(0.0, 0.6, 0.8),
    )
    rows = list(_rows(known, (), TRUTH, NOISE))
    direction, length, height = rows
    assert np.linalg.norm(direction.residual) == pytest.approx(0.3)
    assert np.allclose(direction.covariance, 0.05**2 * np.eye(2))
    assert length.residual == pytest.approx([np.log(1.7 * 2 / 3)])
    assert length.covariance == pytest.approx(np.array([[0.02**2]]))
    assert height.residual == pytest.approx([np.array([0, 0.6, 0.8]) @ onto(TRUTH, np.array([1.0, 0.5, -0.3])) - 1.0])
    assert height.covariance == pytest.approx(np.array([[0.02**2]]))
    for row, numeric in zip(rows[1:], derivative(lambda s: _rows(known, (), s, NOISE))[1:], strict=True):
        assert np.allclose(row.jacobian, numeric, atol=1e-5)
    exact = replace(known, directions=[Direction(up, UP, 0.05)])
    small = derivative(lambda s: _rows(exact, (), s, NOISE))[0]
    assert np.allclose(next(iter(_rows(exact, (), TRUTH, NOISE))).jacobian, small, atol=1e-5)
    opposite = replace(known, directions=[Direction(up, so3_exp(np.array([np.pi - 0.1, 0, 0])) @ UP, 0.05)])
    assert np.linalg.norm(next(iter(_rows(opposite, (), TRUTH, NOISE))).residual) == pytest.approx(np.pi - 0.1)


def test_a_similarity_is_the_same_about_another_centre_and_moves_by_its_parameters() -> None:
    other = TRUTH.about(np.array([3.0, -1.0, 2.0]))
    assert np.allclose(other.matrix, TRUTH.matrix)
    assert np.allclose(other.centre_in_world, [3, -1, 2])
    step = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0, 0.4])
    moved = TRUTH.moved(step)
    assert np.allclose(moved.rotation, so3_exp(step[:3]) @ TRUTH.rotation)
    assert np.allclose(moved.shift, [6, -1, 5])
    assert moved.scale == pytest.approx(1.7 * np.exp(0.4))
    assert TRUTH.moved(9 * step).scale == pytest.approx(1.7 * np.e)
    point = np.array([1.0, 2.0, 3.0, 1.0])
    assert np.allclose((TRUTH.matrix @ point)[:3], onto(TRUTH, point[:3]))


def test_places_that_drift_share_what_came_before() -> None:
    """A random walk along a path of 2 + 2 + 1 m: a tenth of 5 m at its end; rotations sqrt(3) / 10 rad."""
    places = [[0.0, 0, 0], [2.0, 0, 0], [2.0, 2, 0], [2.0, 2, 1]]
    inverse = np.linalg.inv(TRUTH.matrix)
    seen = [
        Observation("p", (inverse @ [*p, 1.0])[:3], np.array(p), world_from_camera=CAMERA, target_from_camera=CAMERA)
        for p in places
    ]
    known = Evidence(seen, drift=0.1)
    used = range(4)
    rows = list(_rows(known, used, TRUTH, NOISE))
    found = _drift_covariance(rows, known, used, NOISE, 24)
    at = np.array([0.0, 2.0, 4.0, 5.0])
    shared = np.minimum.outer(at, at) / 5
    for axis in range(3):
        positions, rotations = np.arange(4) * 6 + axis, np.arange(4) * 6 + 3 + axis
        assert np.allclose(found[np.ix_(positions, positions)], (2.0 * 0.5) ** 2 * shared)
        assert np.allclose(found[np.ix_(rotations, rotations)], (3.0 * np.sqrt(3) * 0.1) ** 2 * shared)
        assert not found[np.ix_(positions, rotations)].any()
    assert not found[np.ix_([0, 6, 12], [1, 7, 13])].any()
    assert not _drift_covariance(rows, replace(known, drift=0.0), used, NOISE, 24).any()
    assert not _drift_covariance(rows[:2], known, [0], NOISE, 6).any()
    without = replace(known, observations=[*seen[:3], replace(seen[3], position=None)])
    assert not _drift_covariance(rows, without, used, NOISE, 24).any()


def test_noise_starts_at_a_hundredth_of_the_spread() -> None:
    """Standard deviation of the places, over all axes: sqrt(2)."""
    seen = [
        Observation("p", np.zeros(3), np.array(p)) for p in ([1.0, 1, 7], [-1.0, 1, 7], [1.0, -1, 7], [-1.0, -1, 7])
    ]
    assert unknown_noise(seen).position_sigma == pytest.approx(0.01 * np.sqrt(2))
    assert unknown_noise(seen[:1]).position_sigma == 1e-9
    assert unknown_noise([]).position_sigma == pytest.approx(0.01)


def test_noise_is_stated_if_it_is_for_each_that_has_it() -> None:
    bare, stated = Observation("a", np.zeros(3), np.zeros(3)), np.eye(3)
    assert not is_stated("position", [bare, replace(bare, position_covariance=stated)])
    assert is_stated("position", [replace(bare, position_covariance=stated), Observation("b", np.zeros(3))])
    turned = replace(bare, target_from_camera=stated)
    assert not is_stated("rotation", [turned, replace(turned, rotation_sigma=0.1)])
    assert is_stated("rotation", [replace(turned, rotation_sigma=0.1), bare])
    assert is_stated("heading", [bare])


def test_estimated_noise_is_that_of_the_residuals() -> None:
    """Of forty places with 0.05 m of noise; with noise stated as 0.5 m it is not taken for less."""
    rng = np.random.default_rng(2)
    seen = [
        replace(seen_at(list(p)), position=onto(TRUTH, p) + rng.normal(0, 0.05, 3)) for p in rng.uniform(-3, 3, (40, 3))
    ]
    known = Evidence(seen)
    fit = fit_similarity(known, range(40), TRUTH, unknown_noise(seen))
    assert fit.noise.position_sigma * fit.noise.factors["position"] == pytest.approx(0.05, rel=0.15)
    assert fit.redundancy("position") == pytest.approx(120 - 7)
    assert fit.redundancy("rotation") == 0
    assert np.allclose(fit.similarity.matrix, TRUTH.matrix, atol=0.06)
    sure = Evidence([replace(o, position_covariance=0.25 * np.eye(3)) for o in seen])
    assert fit_similarity(sure, range(40), TRUTH, unknown_noise(seen)).noise.factors["position"] == 1.0
    daring = Evidence([replace(o, position_covariance=0.01**2 * np.eye(3)) for o in seen])
    assert fit_similarity(daring, range(40), TRUTH, unknown_noise(seen)).noise.factors["position"] == pytest.approx(
        5, rel=0.15
    )


# ------------------------------------------------------------------ starts

PLACES = np.random.default_rng(3).uniform(-2, 2, (5, 3))


def test_umeyamas_similarity_is_exact_and_reflects_where_that_is_asked_for() -> None:
    target = np.array([onto(TRUTH, p) for p in PLACES])
    assert np.allclose(umeyama(PLACES, target).matrix, TRUTH.matrix)
    fixed = umeyama(PLACES, target, 2.0)
    assert fixed.scale == 2.0
    assert np.allclose(fixed.rotation, TRUTH.rotation)
    mirrored = umeyama(PLACES, target * [1, 1, -1], mirrored=True)
    assert np.linalg.det(mirrored.rotation) == pytest.approx(-1)
    assert np.allclose([onto(mirrored, p) for p in PLACES], target * [1, 1, -1])
    proper = umeyama(PLACES, target * [1, 1, -1])
    assert np.linalg.det(proper.rotation) == pytest.approx(1)
    assert umeyama(np.ones((3, 3)), target[:3]).scale == 1.0


def test_the_smallest_rotation_turns_one_direction_to_another() -> None:
    rng = np.random.default_rng(4)
    for source, target in rng.normal(size=(5, 2, 3)):
        source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
        found = turning(source, target)
        assert np.allclose(found @ source, target)
        assert np.trace(found) == pytest.approx(1 + 2 * source @ target)
        half = turning(source, -source)
        assert np.allclose(half @ source, -source)
        assert np.linalg.det(half) == pytest.approx(1)
        assert np.allclose(half @ half.T, np.eye(3))


def test_starts_by_two_places_a_direction_or_a_heading_are_exact() -> None:
    a, b = seen_at(list(PLACES[0])), seen_at(list(PLACES[1]))
    assert np.allclose(_scaled(TRUTH.rotation, a, b, None).matrix, TRUTH.matrix)
    assert _scaled(TRUTH.rotation, a, b, 3.0).scale == 3.0
    middle = onto(_scaled(TRUTH.rotation, a, b, 3.0), (PLACES[0] + PLACES[1]) / 2)
    assert np.allclose(middle, (a.position + b.position) / 2)
    known = Evidence([a, b], directions=[Direction(TRUTH.rotation.T @ UP, UP, 0.01)])
    assert np.allclose(_upright(known, a, b).matrix, TRUTH.matrix)
    turned = TRUTH.rotation @ CAMERA
    heading = float(np.arctan2(turned[0, 2], turned[1, 2]))
    facing = _facing(known, replace(a, world_from_camera=CAMERA, heading=heading), replace(TRUTH, rotation=np.eye(3)))
    assert np.allclose(facing.matrix, TRUTH.matrix)
    assert np.allclose(_mean_rotation([so3_exp(np.array([0, 0, angle])) for angle in (0.1, 0.5)]), so3_exp(0.3 * UP))


def test_the_start_of_everything_at_once() -> None:
    seen = [seen_at(list(p)) for p in PLACES]
    posed = [replace(o, world_from_camera=CAMERA, target_from_camera=TRUTH.rotation @ CAMERA) for o in seen]
    numbers = list(range(5))
    assert np.allclose(_of_all(Evidence(seen), numbers, []).matrix, TRUTH.matrix)
    assert np.allclose(_of_all(Evidence(posed), numbers, numbers).matrix, TRUTH.matrix)
    two = _of_all(Evidence(posed), numbers[:2], numbers)
    assert np.allclose(two.matrix, TRUTH.matrix)
    length = Length(np.zeros(3), np.array([0.0, 0, 2.0]), 5.0, 0.1)
    assert _of_all(Evidence(posed, lengths=[length]), numbers, numbers).scale == 2.5
    assert _of_all(Evidence(posed, lengths=[length], metres_per_unit=4.0), numbers, numbers).scale == 4.0
    alone = _of_all(Evidence(posed[:1]), [0], [0])
    assert (alone.scale, alone.shift.tolist()) == (1.0, posed[0].position.tolist())
    up = _of_all(Evidence(directions=[Direction(TRUTH.rotation.T @ UP, UP, 0.1)]), [], [])
    assert np.allclose(up.rotation @ TRUTH.rotation.T @ UP, UP)
    assert free_parameters(Evidence()) == 7
    assert free_parameters(Evidence(metres_per_unit=2.0)) == 6


def test_all_subsets_are_tried_where_they_are_no_more_than_the_samples() -> None:
    rng = np.random.default_rng(5)
    assert list(_subsets([3, 5, 9], 2, rng, 3)) == [(3, 5), (3, 9), (5, 9)]
    some = list(_subsets([3, 5, 9, 7], 2, rng, 5))
    assert len(some) == 5
    assert all(len(set(pair)) == 2 and set(pair) <= {3, 5, 7, 9} for pair in some)
    assert len(list(_subsets(range(11), 3, rng, 165))) == 165 == len(set(_subsets(range(11), 3, rng, 165)))
    assert len(list(_subsets(range(11), 3, rng, 164))) == 164
    assert list(_subsets([1], 2, rng, 9)) == []
    assert (CONSENSUS.samples, CONSENSUS.refined) == (200, 4)


# ------------------------------------------------------------------ what is determined


def parts_with(monkeypatch: pytest.MonkeyPatch, sigmas: list[float], **known: Any) -> tuple[str, ...]:
    """What counts as determined with these standard deviations of rotation, shift and logarithm of the scale."""
    information = np.diag(1 / np.array(sigmas) ** 2)
    monkeypatch.setattr(determinacy, "_information_without_noise", lambda *_: information)
    seen = [replace(seen_at(list(p)), position_covariance=1e-12 * np.eye(3)) for p in PLACES]
    evidence = Evidence(seen, up=(0.0, 0.0, 1.0), **known)
    fit: Any = SimpleNamespace(similarity=TRUTH, noise=Noise(1e-6))
    parts, reason, _ = determinacy.determined(fit, evidence, range(5))
    assert bool(reason) == (len(parts) < 4)
    return parts


def test_parts_are_determined_by_their_standard_deviations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scale 0.25, rotation 0.26 rad; with the wide prior of 6 rad 0.2602 is a standard deviation of 0.26."""
    good = [0.01] * 7
    everything = ("scale", "up", "heading", "position")
    assert parts_with(monkeypatch, good) == everything
    assert parts_with(monkeypatch, [*good[:6], 0.249]) == everything
    assert parts_with(monkeypatch, [*good[:6], 0.252]) == ("up", "heading")
    for axis in (0, 1):
        for sigma, up in ((0.259, True), (0.262, False)):
            sigmas = list(good)
            sigmas[axis] = sigma
            assert parts_with(monkeypatch, sigmas) == (everything if up else ("scale",))
    assert parts_with(monkeypatch, [0.01, 0.01, 0.259, *good[3:]]) == everything
    assert parts_with(monkeypatch, [0.01, 0.01, 0.262, *good[3:]]) == ("scale", "up")
    assert parts_with(monkeypatch, [0.01, 0.01, 0.01, 1e5, 0.01, 0.01, 0.01]) == ("scale", "up", "heading")
    assert parts_with(monkeypatch, [*good[:6], 1e9], metres_per_unit=1.7) == everything


def test_places_have_a_position_within_a_hundredth_of_the_wide_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which is a thousand spreads: the largest, of the places in the target frame."""
    spread = 1.7 * np.sqrt(np.linalg.eigvalsh(np.cov(PLACES.T, bias=True)).max())
    good = [0.01] * 7
    for share, known in ((9.9, True), (10.1, False)):
        sigmas = [*good[:3], share * spread, *good[4:]]
        assert ("position" in parts_with(monkeypatch, sigmas)) == known


@pytest.mark.parametrize(
    ("places", "reason"),
    [
        ([], "no observation has a position in the target frame"),
        ([[1.0, 2, 3]] * 3, "all 3 places coincide within their noise"),
        ([[1.0, 2, 3], [2.0, 4, 6], [3.0, 6, 9]], "all 3 places lie on one line, about which the scene may turn"),
        ([[1.0, 2, 3], [2.0, 4, 7], [3.0, 7, 9]], "up is uncertain by 29 degrees, the heading by 57"),
    ],
)
def test_the_reason_names_what_is_missing(places: list, reason: str) -> None:
    seen = [replace(seen_at(list(p)), position_covariance=1e-12 * np.eye(3)) for p in places]
    fit: Any = SimpleNamespace(similarity=TRUTH, noise=Noise(1e-6))
    used = range(len(seen))
    axes = determinacy.principal_extents(fit, Evidence(seen), used)
    said = determinacy._reason(("scale",), axes, Evidence(seen), used, 0.5, 1.0)
    assert said == f"up, heading, position can't be determined: {reason}."


# ------------------------------------------------------------------ the registration


def test_what_is_no_evidence_is_refused() -> None:
    with pytest.raises(RegistrationFailed, match="no places"):
        register._check(Evidence())
    for known in (
        {"observations": [seen_at([0.0, 0, 0])]}, {"directions": [Direction(UP, UP, 0.1)]},
        {"lengths": [Length(np.zeros(3), UP, 1.0, 0.1)]}, {"heights": [Height(UP, 1.0, 0.1)]},
    ):  # fmt: skip
        register._check(Evidence(**known))
    for wrong in (seen_at([np.nan, 0, 0]), replace(seen_at([0.0, 0, 0]), position=np.array([0, np.inf, 0]))):
        with pytest.raises(RegistrationFailed, match="finite"):
            register._check(Evidence([seen_at([0.0, 0, 0]), wrong]))
    for length in (Length(UP, UP, 1.0, 0.1), Length(np.zeros(3), UP, 0.0, 0.1)):
        with pytest.raises(RegistrationFailed, match="positive"):
            register._check(Evidence(lengths=[length]))


def mirrored(count: int, noise: float, used: int) -> None:
    """Look whether places that a reflection explains but for noise are refused, of which a fit used so many."""
    rng = np.random.default_rng(6)
    places = rng.uniform(-2, 2, (count, 3))
    seen = [
        Observation("p", p, onto(TRUTH, p) * [1, 1, -1] + noise * sign * np.array([0, 0, 1.0]))
        for p, sign in zip(places, rng.choice([-1, 1], count), strict=True)
    ]
    fit: Any = SimpleNamespace(similarity=umeyama(places, np.array([o.position for o in seen])))
    register._require_right_handed(Evidence(seen), fit, range(used))


def test_coordinates_are_left_handed_where_a_reflection_fits_them_far_better() -> None:
    for count, noise, used in ((5, 0.0, 4), (12, 0.05, 6)):
        with pytest.raises(RegistrationFailed, match="mirrored"):
            mirrored(count, noise, used)
    mirrored(4, 0.0, 3)  # with so few a reflection fits by chance
    mirrored(5, 0.0, 5)  # the fit uses all
    mirrored(12, 1.5, 6)  # the reflection leaves a fifth of the spread


def test_a_reflection_leaves_less_than_a_fifth_of_what_a_rotation_leaves() -> None:
    """Of a nearly flat set of places, whose mirror image a rotation nearly fits."""
    rng = np.random.default_rng(8)
    places = rng.uniform(-2, 2, (9, 3)) * [1, 1, 0.15]
    refused = []
    for noise in np.linspace(0.01, 0.3, 30):
        target = np.array([onto(TRUTH, p) for p in places]) * [1, 1, -1] + noise * rng.choice([-1, 1], (9, 3)) / 2
        seen = [Observation("p", p, q) for p, q in zip(places, target, strict=True)]
        proper, reflected = umeyama(places, target), umeyama(places, target, mirrored=True)
        right, left = (
            max(np.linalg.norm(onto(one, p) - q) for p, q in zip(places, target, strict=True))
            for one in (proper, reflected)
        )
        spread = np.sqrt(np.trace(np.cov(target.T, bias=True)))
        expected = left < 0.2 * right and left < 0.1 * spread
        fit: Any = SimpleNamespace(similarity=proper)
        try:
            register._require_right_handed(Evidence(seen), fit, range(8))
            assert not expected
        except RegistrationFailed:
            assert expected
        refused.append((expected, left / right))
    assert {True, False} == {one for one, _ in refused}
    assert any(0.2 < ratio < 0.35 for _, ratio in refused)


def test_turned_photos_are_looked_for_where_rotations_differ_by_more_than_three_tenths(monkeypatch) -> None:
    """Each quarter turn costs a fit."""
    seen = [replace(full_observation(), name=str(n)) for n in range(3)]
    tried: list[Evidence] = []
    script: list[float] = []

    def agreeing(evidence: Evidence, rng: object) -> tuple[Any, list[int]]:
        tried.append(evidence)
        angle = script[len(tried) - 1]
        row = SimpleNamespace(kind="rotation", residual=np.array([0.0, angle, 0.0]))
        other = SimpleNamespace(kind="position", residual=np.array([9.0, 9.0, 9.0]))
        return SimpleNamespace(rows=(row, row, other)), []

    monkeypatch.setattr(register, "agreeing", agreeing)
    for angles, may, fits, turns in (
        ([0.29], True, 1, 0), ([0.31, 2.0, 0.1, 1.0], True, 4, 2), ([0.31], False, 1, 0),
        ([0.31, 0.5, 0.5, 0.31], True, 4, 0), ([1.5, 1.4, 1.4, 1.3], True, 4, 3),
    ):  # fmt: skip
        tried.clear()
        script[:] = angles
        _, quarter_turns, _ = register._as_turned(Evidence(seen, may_be_turned=may), np.random.default_rng(0))
        assert (len(tried), quarter_turns) == (fits, turns)
    given = seen[0].target_from_camera
    for n in (1, 2, 3):
        about_axis = given.T @ tried[n].observations[0].target_from_camera
        assert np.allclose(about_axis, so3_exp(np.array([0, 0, -n * np.pi / 2])))
    assert register._turn_error(SimpleNamespace(rows=())) == 0.0  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "stated", "warned"),
    [(0, False, False), (1, False, True), (3, False, True), (4, False, False), (3, True, False)],
)
def test_fewer_than_four_places_of_unknown_noise_are_warned_of(count: int, stated: bool, warned: bool) -> None:
    covariance = np.eye(3) if stated else None
    seen = [replace(seen_at(list(p)), position_covariance=covariance) for p in PLACES[:count]]
    seen.append(Observation("q", np.zeros(3)))
    found = register._warnings(Evidence(seen), range(count + 1), "", 0)
    assert found == (("with fewer than four places none can be found to be wrong.",) if warned else ())
    assert register._warnings(Evidence(), (), "why", 3) == (
        "why", "the photos are taken to be turned by 270 degrees clockwise from their poses.",
    )  # fmt: skip


def test_a_residual_is_in_metres_and_degrees() -> None:
    found = register._residual(full_observation(), True, TRUTH)
    assert found.metres == pytest.approx(0.1 * np.sqrt(3))
    assert found.degrees == pytest.approx(np.degrees(0.02 * np.sqrt(3)), rel=0.02)
    heading = register._residual(replace(full_observation(), target_from_camera=None), False, TRUTH)
    assert heading.degrees == pytest.approx(np.degrees(0.2))
    assert register._residual(Observation("p", np.zeros(3)), True, TRUTH).metres is None
    assert register._residual(Observation("p", np.zeros(3)), True, TRUTH).degrees is None


def test_noise_that_few_residuals_tell_widens_the_covariance() -> None:
    """By F's 95 % quantile over that of chi-square: 7 unknowns, 5 numbers left over: 7 * 4.876 / 14.067."""
    rng = np.random.default_rng(7)
    seen = [replace(seen_at(list(p)), position=onto(TRUTH, p) + rng.normal(0, 0.05, 3)) for p in PLACES[:4]]
    known = Evidence(seen)
    fit = fit_similarity(known, range(4), TRUTH, unknown_noise(seen))
    assert fit.redundancy("position") == pytest.approx(5)
    assert register._small_sample_factor(fit, known, range(4)) == pytest.approx(7 * 4.876 / 14.067, rel=1e-3)
    noise = register._noise(fit, known)
    assert list(noise) == ["position"]
    assert noise["position"] == pytest.approx(fit.noise.position_sigma * fit.noise.factors["position"])
    stated = Evidence([replace(o, position_covariance=np.eye(3)) for o in seen])
    sure = fit_similarity(stated, range(4), TRUTH, unknown_noise(seen))
    assert register._small_sample_factor(sure, stated, range(4)) == 1.0
    assert register._noise(sure, stated) == {}


def test_a_look_at_pose_has_the_heading_of_its_axis() -> None:
    """East is 90 degrees, clockwise from north."""
    east = look_at(np.zeros(3), np.array([1.0, 0, 0]), UP).world_from_camera[:3, :3]
    seen = Observation("p", np.zeros(3), world_from_camera=east, heading=np.pi / 2, heading_sigma=0.1)
    upright = Similarity(np.eye(3), 1.0, np.zeros(3), np.zeros(3))
    (row,) = observation_rows(seen, 0, upright, Noise(1.0))
    assert row.residual == pytest.approx([0.0])
    (row,) = observation_rows(replace(seen, heading=0.0), 0, upright, Noise(1.0))
    assert row.residual == pytest.approx([np.pi / 2])
    assert row.covariance == pytest.approx(np.array([[0.01]]))
