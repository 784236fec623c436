"""The bench's figures against numbers worked out by hand."""

import numpy as np
import pytest

from service.bench.pose_metrics import Outcome, Units, errors, summary, units_of
from service.geometry import look_at, moved, pose_distance, so3_exp
from service.pose.features.scene_focus import is_forward_facing
from service.results import Status
from service.types import Camera, Intrinsics, Pose

LENS = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
UP = np.array([0.0, 0.0, 1.0])


def ring(radius: float, centre=(1.0, 2.0, 3.0), count=8) -> list[Camera]:
    centre = np.array(centre)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [centre + radius * np.array([np.cos(a), np.sin(a), 0.5]) for a in angles]
    return [Camera(LENS, look_at(place, centre, UP)) for place in places]


def row(count=5, depth=10.0) -> list[Camera]:
    """Side by side, all looking along x: forward-facing."""
    return [
        Camera(LENS, look_at(np.array([0.0, y, 0.0]), np.array([depth, y, 0.0]), UP)) for y in np.linspace(-1, 1, count)
    ]


class TestUnits:
    def test_orbit(self):
        units = units_of(ring(2.0), lambda camera: pytest.fail("no depth is needed"))
        assert not units.forward_facing
        assert np.allclose(units.focus_in_world, [1, 2, 3])
        # Each camera is 2 sqrt(1 + 1/4) away.
        assert units.units_per_scene_unit == pytest.approx(4 / (2 * np.sqrt(1.25)))

    def test_forward_facing_takes_the_median_depth(self):
        depths = iter([5.0, 6.0, 0.0, 7.0, 1000.0])  # 0: nothing there; one far outlier
        units = units_of(row(), lambda camera: next(depths))
        assert units.forward_facing
        assert np.allclose(units.focus_in_world, [6.5, 0, 0])
        # Distances sqrt(6.5^2 + y^2) for y = -1, -.5, 0, .5, 1: the median has |y| = .5.
        assert units.units_per_scene_unit == pytest.approx(4 / np.hypot(6.5, 0.5))

    def test_normalized_frame(self):
        matrix = units_of(ring(2.0), lambda camera: 0.0).normalized_from_world()
        distances = [np.linalg.norm((matrix @ [*c.pose.position_in_world, 1])[:3]) for c in ring(2.0)]
        assert np.allclose(distances, 4)

    @pytest.mark.parametrize(("spread_deg", "expected"), [(0.0, True), (10.0, True), (20.0, True), (40.0, False)])
    def test_forward_facing_by_the_angle_between_axes(self, spread_deg, expected):
        """Two cameras, each half the angle off the middle."""
        half = np.radians(spread_deg / 2)
        poses = []
        for angle in (-half, half):
            matrix = np.eye(4)
            matrix[:3, :3] = so3_exp(np.array([0, angle, 0]))
            poses.append(Pose(matrix))
        assert is_forward_facing(poses) is expected

    def test_a_corridor_seen_both_ways_is_not_forward_facing(self):
        back = np.eye(4)
        back[:3, :3] = so3_exp(np.array([0, np.pi, 0]))
        assert not is_forward_facing([Pose(np.eye(4)), Pose(back)])


class TestErrors:
    def test_by_hand(self):
        truth = ring(2.0)[0].pose
        estimate = moved(truth, np.array([0, np.radians(3), 0, 0, 0, 0.0]))
        matrix = estimate.world_from_camera.copy()
        matrix[:3, 3] += [0.3, 0, 0.4]
        angle, distance = errors(Pose(matrix), truth, Units(np.zeros(3), 2.0, False))
        assert angle == pytest.approx(3)
        assert distance == pytest.approx(1.0)  # 0.5 scene units are 1 normalized one

    def test_symmetric(self):
        a, b = (camera.pose for camera in ring(2.0)[:2])
        assert pose_distance(a, b) == pytest.approx(pose_distance(b, a))


def outcome(status=Status.LOCALIZED, rotation=0.5, translation=0.005, latency=100.0, cpu=90.0) -> Outcome:
    return Outcome(status, rotation, translation, latency, cpu, asked=(2.0, 0.0045))


class TestSuccess:
    @pytest.mark.parametrize(
        ("one", "coarse", "fine", "false"),
        [
            (outcome(), True, True, False),
            (outcome(rotation=2.0), True, False, False),
            (outcome(translation=0.02), True, False, False),
            (outcome(rotation=6.0), False, False, True),
            (outcome(translation=0.06), False, False, True),
            (outcome(rotation=5.0, translation=0.05), True, False, False),
            (outcome(Status.UNCERTAIN), False, False, False),
            (outcome(Status.NOT_LOCALIZED), False, False, False),
            (outcome(Status.UNCERTAIN, rotation=90.0), False, False, False),
        ],
    )
    def test_joint_and_only_if_called_localized(self, one, coarse, fine, false):
        figures = summary([one])
        assert figures["success_5deg_0p05"] == coarse
        assert figures["success_1deg_0p01"] == fine
        assert figures["false_localized"] == false

    def test_summary(self):
        outcomes = [
            outcome(rotation=0.1, translation=0.001, latency=100.0, cpu=10.0),
            outcome(rotation=3.0, translation=0.004, latency=300.0, cpu=30.0),
            outcome(Status.UNCERTAIN, rotation=0.2, translation=0.002, latency=200.0, cpu=20.0),
            outcome(rotation=50.0, translation=9.0, latency=500.0, cpu=50.0),
        ]
        assert summary(outcomes) == {
            "queries": 4,
            "success_5deg_0p05": 0.5,
            "success_1deg_0p01": 0.25,
            "success_asked": 0.25,
            "median_rotation_deg": pytest.approx(1.6),
            "median_translation_units": pytest.approx(0.003),
            "localized": 3,
            "false_localized": 1,
            "false_asked": 2,
            "latency_ms_p50": pytest.approx(250),
            "latency_ms_p95": pytest.approx(470),  # linear between 300 and 500
            "cpu_ms_p50": pytest.approx(25),
        }
