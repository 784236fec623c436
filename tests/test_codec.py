"""Stored values: text that an earlier run of this version wrote is read as the same values."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from service.accuracy import Accuracy
from service.codec import VERSION, decode, encode
from service.device_readings import DeviceReadings, GpsPosition, Gravity
from service.errors import Failure
from service.jobs.model import JobRecord, JobSpec, SequenceFrame
from service.results import Candidates, IterationRecord, MatchVectors, Reason, Status
from service.types import BoxPrior, Camera, GaussianPosePrior, Intrinsics, LensPrior, Pose

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
LENS = Intrinsics(4, 3, 5.0, 6.0, 2.0, 1.5, "RADIAL", (0.1, 0.2), "approximate")

# As version 1 writes it. If a field is renamed, this test fails: the store needs a new version and a migration.
STORED_RECORD = {
    "version": 1,
    "value": {
        "step": {
            "stage": "match",
            "pose": {"world_from_camera": IDENTITY},
            "correction": {"focal_factor": 1.5, "shift_x": 0.25, "shift_y": -0.25, "k1": 0.125},
            "loss": 0.1,
            "num_matches": 7,
            "num_inliers": None,
            "step_deg": None,
            "step_units": None,
            "matches": {
                "photo_px": [[1.5, 2.25]],
                "render_px": [[3.0, 4.0]],
                "inlier": [True],
                "render_camera": {
                    "intrinsics": {
                        **{"width": 4, "height": 3, "fx": 5.0, "fy": 6.0, "cx": 2.0, "cy": 1.5, "model": "RADIAL"},
                        **{"distortion": [0.1, 0.2], "trust": "approximate"},
                    },
                    "pose": {"world_from_camera": IDENTITY},
                },
            },
            "candidates": None,
            "alternatives": {"world_from_camera": [IDENTITY], "scores": [0.25]},
            "mirrored": True,
            "lens": None,
            "index": 3,
            "elapsed_s": 0.5,
            "cpu_s": 0.25,
        },
        "frame": {
            **{"index": 0, "name": "a.jpg", "time_s": 1.5, "status": "localized", "reason": "verified", "score": 0.75},
            **{"tracked": True, "pose": {"world_from_camera": IDENTITY}, "covariance": None},
            **{"right_place": 0.875, "precise": 0.5},
        },
    },
}
STORED_SPEC = {
    "version": 1,
    "value": {
        **{"estimator": "view_index", "scene": ["a", "b"], "options": {"candidates": 3}, "intrinsics": None},
        "camera_id": "mine",
        "lens": {
            "owner": "key:a",
            "recalled": {
                "id": "0123456789abcdef",
                "intrinsics": {
                    **{"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 1.5, "model": "SIMPLE_RADIAL"},
                    **{"distortion": [0.1], "trust": "approximate"},
                },
                "prior": {"log_focal_scale": 0.01, "k1_sigma": 0.004, "principal_point_scale": 0.006},
                "photos": 3,
            },
        },
        **{
            "prior": {"world_from_camera": IDENTITY},
            "region": {"lower_in_world": [0, 0, 0], "upper_in_world": [1, 2, 3]},
        },
        "readings": {
            "gravity": {"direction": [0.0, -1.0, 0.0], "sigma_deg": 1.0},
            "gps": {
                **{"latitude_deg": 47.0, "longitude_deg": 8.0, "sigma_m": 5.0, "height_m": None},
                "height_sigma_m": 10.0,
            },
            "heading": None,
        },
        "exif_gps": False,
        **{"truth": None, "every": 2, "times_s": [0.5, 1.0], "seed": 7, "budget_s": 0.1, "deadline_s": None},
        "keep_photo": True,
        "accuracy": {"deg": 2.0, "units": 0.5, "metres": None, "share": None},
        "rig": {
            "cameras": [
                {
                    "rig_from_camera": {"world_from_camera": IDENTITY},
                    "intrinsics": {
                        **{"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 1.5, "model": "PINHOLE"},
                        **{"distortion": [], "trust": "exact"},
                    },
                }
            ],
            "metric": True,
        },
    },
}


def test_a_stored_record_is_read():
    record = decode(JobRecord, json.dumps(STORED_RECORD))
    step, frame = record.step, record.frame
    assert (step.stage, step.loss, step.num_matches, step.num_inliers, step.index) == ("match", 0.1, 7, None, 3)
    assert (step.correction.focal_factor, step.correction.shift_y) == (1.5, -0.25)
    assert step.matches
    assert step.matches.photo_px.dtype == np.float32
    assert step.matches.render_camera.intrinsics == LENS
    assert step.alternatives
    assert step.alternatives.world_from_camera.shape == (1, 4, 4)
    assert frame
    assert (frame.status, frame.reason, frame.tracked) == (Status.LOCALIZED, Reason.VERIFIED, True)
    assert json.loads(encode(record)) == STORED_RECORD


def test_a_stored_spec_is_read():
    spec = decode(JobSpec, json.dumps(STORED_SPEC))
    assert (spec.scene, spec.options, spec.times_s, spec.seed) == (("a", "b"), {"candidates": 3}, (0.5, 1.0), 7)
    assert isinstance(spec.region, BoxPrior)
    assert spec.region.upper_in_world.tolist() == [1, 2, 3]
    assert spec.readings == DeviceReadings(Gravity((0.0, -2.0, 0.0)), GpsPosition(47.0, 8.0, 5.0))
    assert spec.lens
    assert spec.lens.recalled
    assert spec.lens.recalled.prior == LensPrior(0.01, 0.004, 0.006)
    assert spec.rig
    assert spec.rig.cameras[0].intrinsics.fx == 5.0
    assert json.loads(encode(spec)) == STORED_SPEC


def test_a_spec_of_before_lenses_were_remembered_is_read():
    value = {name: item for name, item in STORED_SPEC["value"].items() if name not in ("camera_id", "lens")}
    spec = decode(JobSpec, json.dumps({"version": 1, "value": value}))
    assert (spec.camera_id, spec.lens, spec.seed) == (None, None, 7)


def test_what_was_stored_before_an_accuracy_could_be_asked_for_is_read():
    frame = {k: v for k, v in STORED_RECORD["value"]["frame"].items() if k not in ("right_place", "precise")}
    value = STORED_RECORD["value"] | {"frame": frame}
    record = decode(JobRecord, json.dumps({"version": 1, "value": value}))
    assert record.frame
    assert (record.frame.score, record.frame.right_place) == (0.75, None)
    value = {name: item for name, item in STORED_SPEC["value"].items() if name != "accuracy"}
    assert decode(JobSpec, json.dumps({"version": 1, "value": value})).accuracy == Accuracy(deg=5.0, share=0.02)


def test_what_a_later_release_stores_beside_is_left_out():
    later = STORED_RECORD["value"] | {"new": 1, "frame": STORED_RECORD["value"]["frame"] | {"new": {"a": [1]}}}
    record = decode(JobRecord, json.dumps({"version": 1, "value": later}))
    assert json.loads(encode(record)) == STORED_RECORD
    region = STORED_SPEC["value"]["region"] | {"new": 1}  # in a union
    spec = decode(JobSpec, json.dumps({"version": 1, "value": STORED_SPEC["value"] | {"region": region}}))
    assert json.loads(encode(spec)) == STORED_SPEC
    with pytest.raises(ValueError, match="no member"):
        decode(JobSpec, json.dumps({"version": 1, "value": STORED_SPEC["value"] | {"region": {"new": 1}}}))


def test_numbers_survive_exactly():
    rng = np.random.default_rng(0)
    px = rng.normal(size=(5, 2)).astype(np.float32)
    camera = Camera(LENS, Pose(np.eye(4)))
    step = IterationRecord(
        "x",
        Pose(np.eye(4)),
        loss=math.nan,
        step_deg=math.inf,
        matches=MatchVectors.sample(px, px, np.ones(5, bool), camera),
        elapsed_s=0.1 + 0.2,
    )
    again = decode(JobRecord, encode(JobRecord(step))).step
    assert math.isnan(again.loss or 0)
    assert (again.step_deg, again.elapsed_s) == (math.inf, 0.1 + 0.2)
    assert again.matches
    assert np.array_equal(again.matches.photo_px, px)


def test_empty_arrays_keep_their_shape():
    none = np.zeros((0, 2), np.float32)
    matches = MatchVectors.sample(none, none, np.zeros(0, bool), Camera(LENS, Pose(np.eye(4))))
    step = IterationRecord(
        "x", Pose(np.eye(4)), matches=matches, candidates=Candidates(np.zeros((0, 4, 4)), np.zeros(0))
    )
    again = decode(JobRecord, encode(JobRecord(step))).step
    assert again.matches
    assert again.candidates
    assert (again.matches.photo_px.shape, again.candidates.world_from_camera.shape) == ((0, 2), (0, 4, 4))


def test_members_of_unions_are_told_apart():
    gaussian = GaussianPosePrior(Pose(np.eye(4)), np.eye(6))
    for scene, region, kind in (("a", gaussian, GaussianPosePrior), (None, None, type(None))):
        again = decode(JobSpec, encode(JobSpec("e", scene=scene, region=region)))
        assert (again.scene, type(again.region)) == (scene, kind)
    covered = SequenceFrame(0, "", 0.0, Status.UNCERTAIN, Reason.AMBIGUOUS, 0.5, False, Pose(np.eye(4)), np.eye(6))
    covariance = decode(SequenceFrame, encode(covered)).covariance
    assert covariance is not None
    assert np.array_equal(covariance, np.eye(6))


def test_other_versions_and_missing_fields_are_refused():
    stored = {"version": VERSION, "value": {"code": "a", "message": "b"}}
    assert decode(Failure, json.dumps(stored)) == Failure("a", "b")  # what has a default may be missing
    with pytest.raises(ValueError, match="version 2"):
        decode(Failure, json.dumps(stored | {"version": 2}))
    with pytest.raises(TypeError):
        decode(Failure, json.dumps(stored | {"value": {"code": "a"}}))
