"""Properties of rigid motions and projection. A third of the samples lies near the identity, where Taylor works."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry import (
    hat,
    look_at,
    moved,
    nearest_point_to_axes,
    pose_distance,
    project,
    quat_from_rotation,
    rotation_from_quat,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transformed,
    unproject,
)
from service.types import Intrinsics, Pose

# Seen: 4e-15 in general, 3e-12 for logarithms at the seam of Taylor and closed form (1e-4 rad).
TOLERANCE = 1e-10


@st.composite
def vectors(draw, largest: float) -> np.ndarray:
    """A random direction with a length up to `largest`; every third one is tiny or zero."""
    direction = np.random.default_rng(draw(st.integers(0, 2**32))).normal(size=3)
    direction /= np.linalg.norm(direction)
    kind = draw(st.integers(0, 2))
    length = draw(st.floats(0, largest) if kind else st.sampled_from([0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 1e-3]))
    return length * direction


@st.composite
def twists(draw) -> np.ndarray:
    return np.concatenate([draw(vectors(3.1)), draw(vectors(100.0))])


@st.composite
def poses(draw) -> Pose:
    return Pose(se3_exp(draw(twists())))


FOCAL, CENTRE, SIDE = st.floats(10, 5000), st.floats(-500, 4500), st.integers(1, 4000)
LENSES = st.tuples(SIDE, SIDE, FOCAL, FOCAL, CENTRE, CENTRE)
"""Arguments of `Intrinsics`: the type checker of the tests draws random numbers, which a strategy must not."""


def series(matrix: np.ndarray) -> np.ndarray:
    """The matrix exponential by its definition, scaled so that 20 terms are plenty."""
    result, term = np.eye(len(matrix)), np.eye(len(matrix))
    for k in range(1, 20):
        term = term @ matrix / 256 / k
        result = result + term
    for _ in range(8):
        result = result @ result
    return result


def twist_matrix(twist: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = hat(twist[:3]), twist[3:]
    return matrix


class TestExponential:
    @given(twists())
    def test_is_the_matrix_exponential(self, twist):
        # Relative to the translation, which is up to 100. Seen: 3e-13.
        assert np.allclose(se3_exp(twist), series(twist_matrix(twist)), atol=1e-10)
        assert np.allclose(so3_exp(twist[:3]), series(hat(twist[:3])), atol=TOLERANCE)

    @given(twists())
    def test_log_undoes_it(self, twist):
        assert np.allclose(se3_log(se3_exp(twist)), twist, atol=1e-8)  # seen: 2e-11 x a translation of 100
        assert np.allclose(so3_log(so3_exp(twist[:3])), twist[:3], atol=TOLERANCE)

    @given(twists())
    def test_inverse_is_the_negative_twist(self, twist):
        assert np.allclose(se3_exp(twist) @ se3_exp(-twist), np.eye(4), atol=1e-10)

    @given(vectors(3.1))
    def test_rotation(self, vector):
        rotation = so3_exp(vector)
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=TOLERANCE)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert np.allclose(rotation @ vector, vector, atol=TOLERANCE)  # the axis stays

    @given(vectors(1.0))
    def test_half_turn(self, vector):
        """At pi the axis is known up to its sign only."""
        if np.linalg.norm(vector) > 1e-3:
            vector = np.pi * vector / np.linalg.norm(vector)
            found = so3_log(so3_exp(vector))
            assert min(np.abs(found - vector).max(), np.abs(found + vector).max()) < 1e-6  # seen: 1e-7

    @given(vectors(10.0), vectors(10.0))
    def test_hat_is_the_cross_product(self, a, b):
        assert np.allclose(hat(a) @ b, np.cross(a, b))


class TestQuaternions:
    @given(vectors(3.14))
    def test_round_trip(self, vector):
        rotation = so3_exp(vector)
        quat = quat_from_rotation(rotation)
        assert np.linalg.norm(quat) == pytest.approx(1)
        assert quat[0] >= 0
        assert np.allclose(rotation_from_quat(quat), rotation, atol=TOLERANCE)

    @given(vectors(3.14), st.floats(0.01, 100), st.sampled_from([-1, 1]))
    def test_length_and_sign_do_not_matter(self, vector, length, sign):
        quat = quat_from_rotation(so3_exp(vector))
        assert np.allclose(rotation_from_quat(sign * length * quat), so3_exp(vector), atol=TOLERANCE)

    def test_order_is_wxyz(self):
        """A quarter turn about z takes x to y."""
        quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
        assert np.allclose(rotation_from_quat(quarter) @ [1, 0, 0], [0, 1, 0])
        assert np.allclose(quat_from_rotation(so3_exp(np.array([0, 0, np.pi / 2]))), quarter)

    def test_batches(self):
        quats = np.random.default_rng(0).normal(size=(4, 5, 4))
        rotations = rotation_from_quat(quats)
        assert rotations.shape == (4, 5, 3, 3)
        assert np.allclose(rotations[2, 3], rotation_from_quat(quats[2, 3]))


class TestPose:
    @given(poses())
    def test_inverse(self, pose):
        assert np.allclose(pose.world_from_camera @ pose.camera_from_world, np.eye(4), atol=1e-10)
        assert np.allclose(pose.camera_from_world, np.linalg.inv(pose.world_from_camera), atol=1e-8)

    @given(poses(), twists())
    def test_moved_acts_in_the_camera_frame(self, pose, twist):
        found = moved(pose, twist).world_from_camera
        assert np.allclose(found, pose.world_from_camera @ se3_exp(twist), atol=1e-9)

    def test_a_long_chain_stays_rigid(self):
        pose, rng = Pose(np.eye(4)), np.random.default_rng(0)
        for _ in range(2000):
            pose = moved(pose, rng.normal(size=6))
        rotation = pose.world_from_camera[:3, :3]
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14  # seen: 7e-16

    @given(poses(), vectors(3.1), vectors(10.0))
    def test_distance(self, pose, rotation, shift):
        other = moved(pose, np.concatenate([rotation, np.zeros(3)]))
        matrix = other.world_from_camera.copy()
        matrix[:3, 3] += shift
        angle, length = pose_distance(pose, Pose(matrix))
        assert angle == pytest.approx(np.degrees(np.linalg.norm(rotation)), abs=1e-6)
        assert length == pytest.approx(np.linalg.norm(shift), abs=1e-9)


class TestProjection:
    @given(LENSES, st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.1, 50)), min_size=1))
    def test_round_trip(self, arguments, rows):
        lens = Intrinsics(*arguments)
        x, y, depth = np.array(rows).T
        points = np.stack([x * depth, y * depth, depth], 1)
        assert np.allclose(unproject(project(points, lens), depth, lens), points, atol=1e-9)

    @given(LENSES, st.floats(0.05, 3))
    def test_resized_keeps_rays(self, arguments, factor):
        """A point lands at the same fraction of the image, whatever its size."""
        lens = Intrinsics(*arguments)
        width, height = max(1, round(lens.width * factor)), max(1, round(lens.height * factor))
        points = np.array([[0.3, -0.2, 1.0], [0.0, 0.0, 2.0]])
        small = project(points, lens.resized(width, height)) / [width, height]
        assert np.allclose(small, project(points, lens) / [lens.width, lens.height])

    def test_by_hand(self):
        lens = Intrinsics(640, 480, 500.0, 400.0, 320.0, 240.0)
        assert np.allclose(project(np.array([[1.0, 2.0, 4.0]]), lens), [[445, 440]])

    def test_behind_the_camera_is_silent(self):
        found = project(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), Intrinsics(4, 4, 2.0, 2.0, 2.0, 2.0))
        assert not np.isfinite(found).any()

    @given(poses(), vectors(10.0))
    def test_transformed(self, pose, point):
        homogeneous = pose.world_from_camera @ [*point, 1.0]
        assert np.allclose(transformed(pose.world_from_camera, point[None]), homogeneous[None, :3], atol=1e-9)


class TestLooking:
    @given(vectors(20.0), vectors(20.0), vectors(1.0))
    def test_look_at(self, position, target, up):
        if np.linalg.norm(target - position) < 1e-3 or np.linalg.norm(up) < 1e-6:
            return
        pose = look_at(position, target, up)
        assert np.allclose(pose.position_in_world, position)
        assert np.allclose(pose.camera_from_world @ [*target, 1.0], [0, 0, np.linalg.norm(target - position), 1])
        assert -pose.world_from_camera[:3, 1] @ up >= -1e-6  # the picture is not upside down

    def test_look_along_up(self):
        pose = look_at(np.zeros(3), np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, 1.0]))
        assert np.allclose(pose.axis_in_world, [0, 0, 1])

    @given(st.integers(0, 2**32), vectors(50.0))
    def test_nearest_point_to_axes(self, seed, target):
        rng = np.random.default_rng(seed)
        seen = [look_at(target + 5 * rng.normal(size=3), target, rng.normal(size=3)) for _ in range(4)]
        assert np.allclose(nearest_point_to_axes(seen), target, atol=1e-6)

    def test_parallel_axes_have_no_point_but_no_error(self):
        parallel = [Pose(se3_exp(np.array([0, 0, 0, x, 0.0, 0.0]))) for x in (-1.0, 0.0, 1.0)]
        assert np.allclose(nearest_point_to_axes(parallel)[:2], [0, 0])
