"""The parts of a rig's pose: its kernels as plain Python, its refinement and its gate, beside numpy and by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plain_kernels import plain

from service.geometry import adjoint, moved, pose_distance, se3_exp, se3_log, so3_exp, transformed
from service.pose.absolute_pose.rig_pose import RigMatches, RigPose
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.refinement import rig_refinement
from service.pose.refinement.rig_refinement import RigRefinementConfig, _agreement, match_information
from service.pose.verification.appearance import LOCAL_COLOUR
from service.pose.verification.gate import VERIFICATION, VerificationConfig
from service.pose.verification.precision import AskedBounds
from service.pose.verification.rig_gate import RigGateConfig, rig_verdict
from service.results import Reason, Status, Verdict
from service.types import Intrinsics, Pose

ransac = plain("service.pose.absolute_pose.ransac")
rig = plain("service.pose.absolute_pose.rig_kernels")
solve_p3p = plain("service.pose.absolute_pose.p3p").solve_p3p
TRUNCATED, CAUCHY = 0, 1


@pytest.fixture(autouse=True)
def silent() -> Iterator[None]:
    """Divide by zero and overflow as machine code does."""
    with np.errstate(all="ignore"):
        yield


def motion(seed: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(seed).normal(size=6))


def parts(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return matrix[:3, :3].copy(), matrix[:3, 3].copy()


class Rig:
    """Cameras that look in different directions; each has as many matches as `counts` says, the first ones wrong."""

    def __init__(self, seed: int, counts: tuple[int, ...], wrong: int = 0, noise: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.rig_from_world = motion(seed + 50)
        self.camera_from_rig = [motion(seed + 60 + c) for c in range(len(counts))]
        self.counts = np.array(counts)
        self.focals = np.array([[500.0, 480.0], [300.0, 310.0], [700.0, 690.0]])[: len(counts)]
        self.limits = np.array([4.0, 3.0, 6.0])[: len(counts)]
        self.columns = np.full((len(counts), 5, max(counts)), np.nan)
        for own, count, mount in zip(self.columns, counts, self.camera_from_rig, strict=True):
            uv = rng.uniform(-0.6, 0.6, (count, 2))
            local = np.column_stack([uv, np.ones(count)]) * rng.uniform(2, 6, (count, 1))
            own[2:, :count] = transformed(np.linalg.inv(mount @ self.rig_from_world), local).T
            own[:2, :count] = (uv + noise * rng.normal(size=uv.shape)).T
            own[:2, : min(wrong, count)] = rng.uniform(-0.6, 0.6, (2, min(wrong, count)))
        self.rotations = np.stack([mount[:3, :3] for mount in self.camera_from_rig])
        self.translations = np.stack([mount[:3, 3] for mount in self.camera_from_rig])

    @property
    def cameras(self) -> tuple[np.ndarray, ...]:
        return self.rotations, self.translations, self.focals, self.limits

    def errors(self, rig_from_world: np.ndarray) -> list[np.ndarray]:
        """Reprojection errors of each camera's own matches, px (n, 2)."""
        found = []
        for c, (own, count) in enumerate(zip(self.columns, self.counts, strict=True)):
            local = transformed(self.camera_from_rig[c] @ rig_from_world, own[2:, :count].T)
            found.append((local[:, :2] / local[:, 2:] - own[:2, :count].T) * self.focals[c])
        return found

    def loss(self, rig_from_world: np.ndarray, loss: int) -> float:
        """In squares of the limits; what a camera has no matches for counts as behind it."""
        total = 0.0
        for errors, limit, count in zip(self.errors(rig_from_world), self.limits, self.counts, strict=True):
            ratio, absent = (errors**2).sum(1) / limit**2, self.columns.shape[2] - count
            one, most = (np.minimum(ratio, 1), 1.0) if loss == TRUNCATED else (np.log(1 + ratio), np.log(2))
            total += one.sum() + absent * most
        return total


# ------------------------------------------------------------------ kernels


def test_motions_are_composed() -> None:
    left, right = motion(1), motion(2)
    rotation, translation = np.empty((3, 3)), np.empty(3)
    rig.compose(*parts(left), *parts(right), rotation, translation)
    assert np.allclose(np.column_stack([rotation, translation]), (left @ right)[:3])
    rig.after_inverse(*parts(left), *parts(right), rotation, translation)
    assert np.allclose(np.column_stack([rotation, translation]), (np.linalg.inv(left) @ right)[:3])


def test_a_rig_is_scored_in_squares_of_its_cameras_limits() -> None:
    planted = Rig(3, (12, 20, 9), wrong=4, noise=0.003)
    columns, (rotations, translations, focals, limits) = planted.columns, planted.cameras
    own = np.empty((4, 3))
    cost, inliers = rig.score_rig(
        columns, rotations, translations, focals, limits, *parts(planted.rig_from_world), own[:3], own[3]
    )
    assert cost == pytest.approx(planted.loss(planted.rig_from_world, TRUNCATED))
    norms = [np.linalg.norm(errors, axis=1) for errors in planted.errors(planted.rig_from_world)]
    assert inliers == sum((norm < limit).sum() for norm, limit in zip(norms, limits, strict=True))


@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_a_rigs_normal_equations_are_those_of_finite_differences(loss: int) -> None:
    planted = Rig(4, (12, 15, 10), noise=0.003)
    total, gradient = np.full((6, 6), np.nan), np.full(6, np.nan)
    own, work = np.zeros((4, 3)), np.zeros((4, 6, 6))
    pose = parts(planted.rig_from_world)
    cost = rig.linearize_rig(planted.columns, *planted.cameras, loss, *pose, own, work, total, gradient)
    assert cost == pytest.approx(planted.loss(planted.rig_from_world, loss))

    def shifted(step: np.ndarray) -> np.ndarray:
        """The twist is (translation, rotation), on the left."""
        matrix = planted.rig_from_world.copy()
        turn = so3_exp(step[3:])
        matrix[:3, :3], matrix[:3, 3] = turn @ matrix[:3, :3], turn @ matrix[:3, 3] + step[:3]
        return matrix

    steps = 1e-6 * np.eye(6)
    numeric = [planted.loss(shifted(step), loss) - planted.loss(shifted(-step), loss) for step in steps]
    assert np.allclose(gradient, np.array(numeric) / 4e-6, rtol=1e-4, atol=1e-2)
    by_hand = np.zeros((6, 6))
    ends = [(planted.errors(shifted(step)), planted.errors(shifted(-step))) for step in steps]
    for c, (errors, limit) in enumerate(zip(planted.errors(planted.rig_from_world), planted.limits, strict=True)):
        jacobian = np.stack([(one[c] - other[c]) / 2e-6 for one, other in ends], -1)
        ratio = (errors**2).sum(1) / limit**2
        weights = (ratio < 1) * 1.0 if loss == TRUNCATED else 1 / (1 + ratio)
        by_hand += np.einsum("n,nci,ncj->ij", weights, jacobian, jacobian) / limit**2
    lower = np.tril_indices(6)
    assert np.allclose(total[lower], by_hand[lower], rtol=1e-5, atol=1e-2)


def test_a_rig_is_refined_in_a_few_steps() -> None:
    planted = Rig(5, (8, 8, 8))
    offset = se3_exp(np.array([0.02, -0.01, 0.02, 0.02, -0.03, 0.02]))
    errors = []
    for steps in (1, 3, 5):
        rotation, translation = parts(offset @ planted.rig_from_world)
        rotations, translations, focals, limits = planted.cameras
        arguments = (planted.columns, rotations, translations, focals, 20 * limits, CAUCHY, steps, 0.0)
        rig.refine_rig(*arguments, rotation, translation)
        errors.append(np.abs(np.column_stack([rotation, translation]) - planted.rig_from_world[:3]).max())
    assert errors[0] < 5e-3
    assert errors[1] < 1e-6
    assert errors[2] < 1e-11


def test_a_rigs_refinement_ends_as_that_of_one_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[int] = []
    names = rig.refine_rig.__globals__
    monkeypatch.setitem(names, "damped_step", lambda *given: solved.append(1) or ransac.damped_step(*given))
    offset = se3_exp(np.array([0.02, -0.01, 0.02, 0.02, -0.03, 0.02]))
    planted, lengths = Rig(6, (8, 8, 8)), []
    rotations, translations, focals, limits = planted.cameras
    for scale, tolerance in ((1, 1.0), (1, 1e-3), (100, 1e-3), (1, 1e-7)):
        solved.clear()
        columns = planted.columns.copy()
        columns[:, 2:] *= scale
        rotation, translation = parts(offset @ planted.rig_from_world)
        translation *= scale
        rig.refine_rig(
            columns,
            rotations,
            translations * scale,
            focals,
            20 * limits,
            TRUNCATED,
            50,
            tolerance,
            rotation,
            translation,
        )
        lengths.append(len(solved))
    assert lengths[0] == 1
    assert 1 < lengths[1] == lengths[2] < lengths[3] < 8
    # At the minimum no step is better: the damping rises tenfold from 1e-3 to 1e10, 13 times.
    noisy = Rig(6, (8, 8, 8), noise=0.002)
    rotation, translation = parts(noisy.rig_from_world)
    for steps, tolerance in ((50, 1e-12), (100, 0.0)):
        solved.clear()
        rig.refine_rig(noisy.columns, *noisy.cameras, CAUCHY, steps, tolerance, rotation, translation)
    assert 13 <= len(solved) < 40  # seen: 23, as a step within rounding may count as better


def searched(planted: Rig, starts: np.ndarray, trials: tuple[int, int] = (20, 200)) -> tuple[np.ndarray, ...]:
    rotations, translations, focals, limits = planted.cameras
    return rig.solve_rig(
        planted.columns, planted.counts, rotations, translations, focals, limits, starts, trials, (0.999, 1.5), (5, 10),
        0, 0.5, 1e-9,
    )  # fmt: skip


def test_a_planted_rig_and_its_inliers_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    planted, sampled = Rig(7, (14, 3, 10), wrong=3, noise=0.0005), []
    names = rig.search_rig.__globals__
    monkeypatch.setitem(names, "solve_p3p", lambda *given: sampled.append(given[1].copy()) or solve_p3p(*given))
    rotation, translation, inlier = searched(planted, np.zeros((0, 4, 3)))
    # Seen: 5e-4.
    assert np.abs(np.column_stack([rotation, translation]) - planted.rig_from_world[:3]).max() < 3e-3
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, translation
    for c, errors in enumerate(planted.errors(found)):
        within = np.linalg.norm(errors, axis=1) < planted.limits[c]
        assert np.array_equal(inlier[c, : len(errors)], within)
        assert not inlier[c, len(errors) :].any()
    assert inlier.sum() >= 18
    # The cameras take turns but for the one with three matches, which has none to check them with.
    of_camera = [[c for c in range(3) if np.isin(points[:, 0], planted.columns[c, 2]).all()] for points in sampled]
    assert of_camera[:6] == [[0], [2], [0], [2], [0], [2]]
    assert len(sampled) < 2 * 200
    assert len(sampled) >= 2 * 20 - 1


def test_a_found_rig_is_at_the_minimum_of_cauchys_loss_of_its_inliers() -> None:
    """At half of the limits, as the scale of the loss is asked for."""
    planted = Rig(12, (14, 12), wrong=2, noise=0.002)
    rotation, translation, inlier = searched(planted, np.zeros((0, 4, 3)))
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, translation

    def loss(matrix: np.ndarray) -> float:
        errors = zip(planted.errors(matrix), planted.limits, inlier, planted.counts, strict=True)
        return sum(
            float(np.log1p((error[own[:count]] ** 2).sum(1) / (0.5 * limit) ** 2).sum())
            for error, limit, own, count in errors
        )

    assert inlier.sum() >= 20
    for step in 1e-4 * np.vstack([np.eye(6), -np.eye(6)]):
        assert loss(se3_exp(step) @ found) > loss(found)


def test_four_matches_of_a_camera_are_sampled_and_end_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them agree: after the fewest trials, of two cameras."""
    planted, sampled = Rig(11, (4, 3, 4)), []
    names = rig.search_rig.__globals__
    monkeypatch.setitem(names, "solve_p3p", lambda *given: sampled.append(1) or solve_p3p(*given))
    _, _, inlier = searched(planted, np.zeros((0, 4, 3)))
    assert inlier.sum() == 11
    assert 2 * 20 - 1 <= len(sampled) <= 2 * 20


def test_starts_are_tried_first_and_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    planted = Rig(8, (3, 3, 3))  # too few in each camera to be sampled from
    near = se3_exp(np.full(6, 0.004)) @ planted.rig_from_world
    starts = np.zeros((2, 4, 3))
    for number, matrix in enumerate((motion(99), near)):
        starts[number, :3], starts[number, 3] = parts(matrix)
    rotation, translation, inlier = searched(planted, starts)
    assert np.abs(np.column_stack([rotation, translation]) - planted.rig_from_world[:3]).max() < 1e-8
    assert inlier.all()
    rotation, _, inlier = searched(planted, starts[:0])
    assert not inlier.any()
    assert not rotation.any()


def test_a_camera_samples_as_one_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pools of a rig of one camera are those of `search_pose`, with the same random numbers."""
    rng = np.random.default_rng(9)
    columns = np.vstack([rng.uniform(-1, 1, (2, 9)), rng.normal(size=(3, 9))])
    focal, drawn = np.array([500.0, 480.0]), []

    def recorded(state: np.ndarray, below: int, count: int, chosen: np.ndarray) -> None:
        ransac.draw(state, below, count, chosen)
        drawn.append((int(below), count, chosen[:count].tolist()))

    monkeypatch.setitem(ransac.search_pose.__globals__, "draw", recorded)
    monkeypatch.setitem(rig.search_rig.__globals__, "draw", recorded)
    ransac.search_pose(columns, focal, 2.0, 1, 60, 0.99, 1e9, 2, 0, np.zeros((3, 3)), np.zeros(3))
    alone, drawn = drawn, []
    rig.search_rig(
        columns[None], np.array([9]), np.eye(3)[None], np.zeros((1, 3)), focal[None], np.array([2.0]),
        np.zeros((0, 4, 3)), 1, 60, 0.99, 1e9, 2, 0, np.zeros((3, 3)), np.zeros(3),
    )  # fmt: skip
    assert len(drawn) == 60
    assert drawn == alone


# ------------------------------------------------------------------ refinement

LENSES = (Intrinsics(640, 480, 500, 480, 320, 240), Intrinsics(1280, 960, 900, 910, 640, 480))


def seen_by_two(count: int) -> tuple[list[RigMatches], RigPose]:
    """Two cameras with `count` matches each, of which the last disagrees, and the rig's pose."""
    world_from_rig, cameras, inliers = Pose(motion(20)), [], []
    for number, lens in enumerate(LENSES):
        mount = Pose(motion(21 + number))
        local = np.random.default_rng(number).uniform([-1, -1, 3], [1, 1, 6], (count, 3))
        points = transformed(world_from_rig.world_from_camera @ mount.world_from_camera, local)
        cameras.append(RigMatches(projected(local, lens), points, lens, mount, 4.0))
        inliers.append(np.arange(count) < count - 1)
    return cameras, RigPose(world_from_rig, tuple(inliers))


def projected(local: np.ndarray, lens: Intrinsics) -> np.ndarray:
    return local[:, :2] / local[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]


@pytest.mark.parametrize(("count", "most", "share"), [(11, 60, 1.0), (41, 60, 0.75), (11, 10, 0.5)])
def test_matches_inform_of_a_rigs_twist_as_finite_differences_say(count: int, most: int, share: float) -> None:
    """Each has a standard deviation of 4 px at the size of photos; no more than `most` count."""
    cameras, found = seen_by_two(count)
    information = np.zeros((6, 6))
    for camera, agree in zip(cameras, found.inliers, strict=True):
        sigma = 4.0 * camera.intrinsics.long_side / PHOTO_PX
        columns = []
        for step in 1e-6 * np.eye(6):
            ends = []
            for sign in (1, -1):
                pose = moved(found.world_from_rig, sign * step).world_from_camera
                local = transformed(
                    np.linalg.inv(pose @ camera.rig_from_camera.world_from_camera), camera.points_in_world[agree]
                )
                ends.append(projected(local, camera.intrinsics).ravel())
            columns.append((ends[0] - ends[1]) / 2e-6)
        jacobian = np.stack(columns, 1) / sigma
        information += jacobian.T @ jacobian
    config = RigRefinementConfig(most_matches=most)
    assert np.allclose(match_information(cameras, found, config), share * information, rtol=1e-5, atol=1e-3)
    assert RigRefinementConfig().match_sigma_px == 4.0
    assert RigRefinementConfig().most_matches == 60


def test_what_contradicts_the_matches_weighs_less() -> None:
    """Cauchy's weight: a half where the squared distance is six, the number of dimensions."""
    to_camera, half = adjoint(motion(30)), np.random.default_rng(3).normal(size=(6, 9))
    covariance, information = half @ half.T, np.diag([1.0, 2, 3, 4, 5, 6])
    spread = covariance + to_camera @ np.diag(1 / np.diag(information)) @ to_camera.T
    gap = np.linalg.cholesky(spread)[:, 0]  # at a distance of one
    for distance, weight in ((0.0, 1.0), (1.0, 6 / 7), (6**0.5, 0.5), (18**0.5, 0.25)):
        assert _agreement(distance * gap, to_camera, covariance, information) == pytest.approx(weight)
    assert _agreement(gap, to_camera, covariance, np.diag([1.0, 1, 1, 1, 1, 0])) == 1.0


def test_a_rig_is_moved_to_the_least_squares_of_matches_and_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos that ask for one pose of the rig, as exactly as they agree with the matches, get it."""
    matched, goal = Pose(motion(40)), moved(Pose(motion(40)), 1e-3 * np.array([1.0, -2, 1, 2, 1, -1]))
    mounts, asked = [Pose(motion(41)), Pose(motion(42))], []

    def by_plan(images: object, pose: Pose, renderer: object, size_px: int, levels: int):
        asked.append((images, size_px, levels))
        if images == "hidden":
            return None
        mount = mounts[images]
        target = goal.world_from_camera @ mount.world_from_camera
        return se3_log(pose.camera_from_world @ target), 1e-8 * np.eye(6)

    monkeypatch.setattr(rig_refinement, "_asked_by", by_plan)
    cameras = [(0, mounts[0]), ("hidden", Pose(np.eye(4))), (1, mounts[1])]
    weak = 1e-2 * np.eye(6)
    found, covariance = rig_refinement.refine_rig(cameras, matched, weak, None)
    assert pose_distance(found, goal)[0] < 1e-4
    assert pose_distance(found, goal)[1] < 1e-6
    assert asked == [
        (name, size, levels) for size, levels in ((256, 2), (416, 1), (416, 1)) for name in (0, "hidden", 1)
    ]
    by_hand = weak + sum(adjoint(m.camera_from_world).T @ adjoint(m.camera_from_world) * 1e8 for m in mounts)
    assert np.allclose(covariance, np.linalg.inv(by_hand), rtol=1e-3, atol=1e-14)
    # Where the photos say nothing, the matches' pose and covariance stay; without either nothing is known.
    alone = [("hidden", mounts[0])]
    found, covariance = rig_refinement.refine_rig(alone, matched, weak, None)
    assert np.allclose(found.world_from_camera, matched.world_from_camera)
    assert np.allclose(covariance, 100 * np.eye(6))
    assert rig_refinement.refine_rig(alone, matched, np.zeros((6, 6)), None) == (matched, None)


# ------------------------------------------------------------------ gate

GATE = RigGateConfig()
ASKED = AskedBounds(2.0, 0.1, 3.0)
TIGHT = np.diag([1e-6] * 3 + [1e-8] * 3)


def photo_verdict(inliers: int = 100, share: float = 0.5, colour: float = 0.99) -> Verdict:
    signals = {"inliers": float(inliers), "inlier_share": share, LOCAL_COLOUR: colour}
    return Verdict(Status.NOT_LOCALIZED, Reason.FEW_INLIERS, 0.1, inliers, 0.5, 1.0, None, signals=signals)


def gate_with(probability: float) -> VerificationConfig:
    """The gate, with a model that finds every photo alike."""
    return replace(VERIFICATION, model=SimpleNamespace(probability=lambda signals: probability))


def rig_gate(
    photos: list[Verdict], rival: float = 0.0, covariance: np.ndarray | None = TIGHT, probability: float = 0.9
) -> Verdict:
    return rig_verdict(photos, covariance, ASKED, rival, GATE, gate_with(probability))


def test_a_rig_is_accepted_if_two_photos_agree() -> None:
    found = rig_gate([photo_verdict(), photo_verdict(), photo_verdict(3, 0.01)])
    assert (found.status, found.reason, found.inliers) == (Status.LOCALIZED, Reason.VERIFIED, 203)
    assert found.signals == {"agreeing": 2.0, "contradicting": 0.0, "rival_share": 0.0}
    assert found.precise == pytest.approx(1.0, abs=1e-4)
    assert found.asked == (2.0, 0.1)
    assert found.covariance is TIGHT
    alone = rig_gate([photo_verdict(), photo_verdict(3, 0.01)])
    assert (alone.status, alone.reason) == (Status.UNCERTAIN, Reason.FEW_INLIERS)
    assert alone.right_place is not None
    assert found.right_place is not None
    assert alone.right_place <= VERIFICATION.doubtful_score
    assert found.right_place > 0.8
    assert found.score == pytest.approx(found.right_place * found.precise)


def test_each_photo_that_agrees_is_evidence_by_itself() -> None:
    """Two of probability 0.9 are wrong in one of a hundred cases; 0.6 is the least, whatever the model says."""
    for probability, place in ((0.9, 0.99), (0.1, 1 - 0.4**2)):
        found = rig_gate([photo_verdict(), photo_verdict()], probability=probability)
        assert found.right_place == pytest.approx(place)


@pytest.mark.parametrize(
    ("photo", "agrees", "contradicts"),
    [
        (photo_verdict(25, 0.2, 0.97), 1, 0),
        (photo_verdict(24, 0.2, 0.97), 0, 0),
        (photo_verdict(25, 0.199, 0.97), 0, 0),
        (photo_verdict(25, 0.2, 0.9699), 0, 1),
        (photo_verdict(24, 0.5, 0.5), 0, 0),
        (photo_verdict(100, 0.1, 0.5), 0, 0),
    ],
)
def test_matches_and_colours_make_a_photo_agree_or_contradict(photo: Verdict, agrees: int, contradicts: int) -> None:
    found = rig_gate([photo_verdict(), photo_verdict(), photo])
    assert found.signals["agreeing"] == 2 + agrees
    assert found.signals["contradicting"] == contradicts


def test_a_photo_without_signals_can_not_tell() -> None:
    bare = replace(photo_verdict(), signals={})
    assert rig_gate([photo_verdict(), photo_verdict(), bare]).signals["agreeing"] == 2


@pytest.mark.parametrize(
    ("photos", "rival", "reason"),
    [
        ([photo_verdict(40), photo_verdict(40)], 0.5, Reason.VERIFIED),
        ([photo_verdict(40), photo_verdict(40)], 0.501, Reason.AMBIGUOUS),
        ([photo_verdict(40), photo_verdict(39)], 0.0, Reason.FEW_INLIERS),
        ([photo_verdict(0), photo_verdict(0)], 0.0, Reason.NO_MATCHING_VIEW),
        ([photo_verdict()] * 2 + [photo_verdict(colour=0.5)], 0.0, Reason.VERIFIED),
        ([photo_verdict()] * 2 + [photo_verdict(colour=0.5)] * 2, 0.0, Reason.RENDER_MISMATCH),
    ],
)
def test_reasons_of_a_rigs_verdict(photos: list[Verdict], rival: float, reason: Reason) -> None:
    found = rig_gate(photos, rival)
    assert found.reason is reason
    assert (found.status is Status.LOCALIZED) == (reason is Reason.VERIFIED)
    assert found.right_place is not None
    assert (found.right_place > VERIFICATION.doubtful_score) == (reason is Reason.VERIFIED)


def test_what_is_not_precise_enough_is_uncertain_and_without_covariance_nothing_is_told() -> None:
    vague = rig_gate([photo_verdict(), photo_verdict()], covariance=np.eye(6))
    assert (vague.status, vague.reason) == (Status.UNCERTAIN, Reason.POSITION_UNCERTAIN)
    assert vague.precise is not None
    assert vague.precise < VERIFICATION.min_precise
    unknown = rig_gate([photo_verdict(), photo_verdict()], covariance=None)
    assert unknown.status is Status.NOT_LOCALIZED
    assert unknown.precise == 0.0
    assert rig_gate([photo_verdict(colour=0.5)] * 2).status is Status.NOT_LOCALIZED
