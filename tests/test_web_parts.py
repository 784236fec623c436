"""Parts of the API and of commands by themselves, on planted values: GeoPose, metrics, responses, registering."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from stand_ins import TURNED

from service.cli import scenes_onto, scenes_register
from service.errors import InvalidIntrinsics, InvalidPrior, InvalidRequest, NoGeoAnchor, RegistrationFailed
from service.photos.images import encode_image
from service.registration.known_places.known_place import KnownPlace, KnownPlaces
from service.registration.registration import PARTS, Origin, Registration, Residual
from service.results import Reason, Status
from service.types import Camera, GeoAnchor, Intrinsics, NamedCamera, Pose, SceneInfo
from service.web.metrics import Metrics
from service.web.problems import Problem, problem_answer
from service.web.routes import registrations
from service.web.schemas import geopose_protocol as protocol
from service.web.schemas.error_examples import errors

# ------------------------------------------------------------------ OGC GeoPose


def anchor(latitude: float = 0.0, longitude: float = 0.0, scale: float = 1.0) -> GeoAnchor:
    return GeoAnchor(latitude, longitude, 0.0, np.diag([scale, scale, scale, 1.0]))


def asked(**fields: Any) -> protocol.GeoPoseRequest:
    return protocol.GeoPoseRequest(id="7", **{"sensorReadings": {}, **fields})


def at(latitude: float, longitude: float) -> Any:
    return protocol.GeolocationReading(latitude=latitude, longitude=longitude)


@pytest.mark.parametrize(
    ("here", "there", "metres"),
    [
        ((0, 0), (0, 90), 10_007_543),  # a quarter of the equator, of 2 pi x 6371 km
        ((0, 0), (0, 180), 20_015_087),
        ((90, 0), (-90, 30), 20_015_087),
        ((10, 20), (10, 20), 0),
        ((60, 0), (60, 180), 6_671_696),  # over the pole: 60 degrees
        ((48.8567, 2.3508), (52.5200, 13.4050), 877_500),  # Paris to Berlin
    ],
)
def test_distances_are_those_of_great_circles(here, there, metres):
    assert protocol._distance_m(anchor(*here), at(*there)) == pytest.approx(metres, rel=2e-3, abs=1)


def status(name: str, place: GeoAnchor | None) -> Any:
    return SimpleNamespace(id=name, info=SimpleNamespace(geo_anchor=place))


def test_the_scene_nearest_to_the_last_reading_is_searched():
    scenes = [status("paris", anchor(48.86, 2.35)), status("berlin", anchor(52.52, 13.4)), status("none", None)]
    readings = [{"latitude": 52.5, "longitude": 13.4}, {"latitude": 49.0, "longitude": 3.0}]
    request = asked(sensorReadings={"geolocationReadings": readings})
    assert protocol.nearest_scene(scenes, request) == "paris"
    assert protocol.nearest_scene(scenes[1:], asked()) == "berlin"  # one needs no reading
    with pytest.raises(NoGeoAnchor, match="several scenes have"):
        protocol.nearest_scene(scenes, asked())
    for none in ([status("none", None), SimpleNamespace(id="unloaded", info=None)], []):
        with pytest.raises(NoGeoAnchor, match="no scene in memory has"):
            protocol.nearest_scene(none, request)


def camera(model: str | None, params: list[float], size: tuple[int, ...] = (640, 480)) -> Any:
    return protocol.CameraReading(
        imageBytes="",
        size=list(size),
        params={"model": model, "modelParams": params},  # type: ignore[arg-type]
    )


def test_camera_models_have_colmaps_parameters():
    found = protocol._intrinsics(camera("SIMPLE_RADIAL", [500, 320, 240, 0.1]))
    assert found == {
        "model": "SIMPLE_RADIAL", "width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240,
        "distortion": [0.1],
    }  # fmt: skip
    found = protocol._intrinsics(camera("OPENCV", [500, 510, 320, 240, 0.1, 0.2, 0.3, 0.4]))
    assert found is not None
    assert (found["fx"], found["fy"], found["cx"], found["distortion"]) == (500, 510, 320, [0.1, 0.2, 0.3, 0.4])
    for none in (None, "UNKNOWN", "UNKNOWN_CAMERA"):
        assert protocol._intrinsics(camera(none, [500, 320, 240])) is None
    assert protocol._intrinsics(camera("PINHOLE", [])) is None
    for wrong, says in (
        (camera("PINHOLE", [500, 320, 240]), "has 4 parameters"),
        (camera("PINHOLE", [500, 500, 320, 240], (640,)), "needs `size`"),
        (camera("FOV", [500, 500, 320, 240, 1]), "unknown camera model"),
    ):
        with pytest.raises(InvalidIntrinsics, match=says):
            protocol._intrinsics(wrong)


def prior(w: float, accuracy: Any = None) -> protocol.GeoPoseRequest:
    geopose = {"position": {"lat": 0, "lon": 0, "h": 8.0}, "quaternion": {"x": 0, "y": 0, "z": 0, "w": w}}
    return asked(priorPoses=[{"geopose": geopose}, {"geopose": geopose, "accuracy": accuracy}])


def test_a_prior_pose_is_in_the_scenes_units():
    place = anchor(scale=4.0)  # metres a unit
    assert protocol.prior_of(asked(), place) is None
    found = protocol.prior_of(prior(1.0, {"position": 2.0, "orientation": 5.0}), place)
    assert found is not None
    assert (found.sigma_units, found.sigma_deg) == pytest.approx((0.5, 5.0))
    assert np.array(found.world_from_camera)[:3, 3] == pytest.approx([0, 0, 2.0], abs=1e-6)
    without = protocol.prior_of(prior(1.0009), place)
    assert without is not None
    assert without.sigma_units is None
    for w in (1.0011, 0.9989, float("nan")):
        with pytest.raises(InvalidPrior, match="must have length 1"):
            protocol.prior_of(prior(w), place)


def test_the_accuracy_is_that_of_one_component_in_metres_and_degrees():
    geopose = {"position": {"lat": 1, "lon": 2, "h": 3}, "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1}}
    matrix = np.diag(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) ** 2)

    def told(**fields: Any) -> Any:
        given = {"geopose": protocol.GeoPose.model_validate(geopose), "registered": None, "covariance": None} | fields
        result: Any = SimpleNamespace(**given)
        return protocol.response_of(asked(), result, anchor(scale=2.0))

    assert told().accuracy is None
    assert told().id == "7"
    accuracy = told(covariance=SimpleNamespace(matrix=matrix.tolist())).accuracy
    assert accuracy.position == pytest.approx(2 * np.sqrt((16 + 25 + 36) / 3))
    assert accuracy.orientation == pytest.approx(np.degrees(np.sqrt((1 + 4 + 9) / 3)))
    for unknown in ({"sigma_m": None, "sigma_deg": 3.0}, {"sigma_m": 3.0, "sigma_deg": None}):
        assert told(registered=SimpleNamespace(**unknown)).accuracy is None
    # Lengths of three equal components.
    accuracy = told(registered=SimpleNamespace(sigma_m=np.sqrt(12), sigma_deg=np.sqrt(27))).accuracy
    assert (accuracy.position, accuracy.orientation) == pytest.approx((2.0, 3.0))
    now = protocol.time.time()
    assert abs(told().timestamp / 1000 - now) < 60


# ------------------------------------------------------------------ metrics


def sampled(data: bytes) -> dict[str, float]:
    return {
        f"{sample.name}{sorted(sample.labels.values())}": sample.value
        for family in text_string_to_metric_families(data.decode())
        for sample in family.samples
    }


def test_frames_of_live_sessions_are_counted_with_those_dropped():
    metrics = Metrics()
    metrics.live_frame("tracking", "localized", 0.025, 0)
    metrics.live_frame("tracking", "localized", 0.5, 3)
    metrics.live_frame("lost", "none", 0.1, 1)
    metrics.live_closed(1000)
    metrics.rendered("room", 0.25)
    metrics.renders("view_index", 7)
    metrics.stage("view_index", "match", 0.5)
    metrics.gauge("width", "Of it", ("side",), lambda: {("left",): 2.5})
    found = sampled(metrics.exposition())
    assert found["splatfix_live_frames_total['localized']"] == 2
    assert found["splatfix_live_frames_total['dropped']"] == 4
    assert found["splatfix_live_answer_seconds_sum['tracking']"] == 0.525
    assert found["splatfix_live_answer_seconds_bucket['0.03', 'tracking']"] == 1
    assert found["splatfix_live_closed_total['1000']"] == 1
    assert found["splatfix_render_seconds_sum['room']"] == 0.25
    assert found["splatfix_renders_total['view_index']"] == 7
    assert found["splatfix_stage_seconds_sum['match', 'view_index']"] == 0.5
    assert found["splatfix_width['left']"] == 2.5


def test_a_key_sees_its_own_jobs_and_its_scenes():
    metrics = Metrics()
    for client, scene in (("key:a:1", "room"), ("key:b:2", "room"), ("key:a:1", "lab"), ("10.0.0.1", "room")):
        job: Any = SimpleNamespace(estimator="e", state="succeeded", status="localized", client=client, scene=scene)
        metrics.ended(job, 2.0)
    seen = sampled(metrics.exposition_of("key:a:1", lambda scene: scene == "room"))
    assert {name: value for name, value in seen.items() if "total" in name} == {
        "splatfix_jobs_by_key_total['a', 'room', 'succeeded']": 1,
        "splatfix_job_seconds_by_key_total['a', 'room']": 2,
    }
    whole = sampled(metrics.exposition())
    assert whole["splatfix_jobs_by_key_total['none', 'room', 'succeeded']"] == 1


def test_invented_methods_are_one_series():
    metrics = Metrics()
    for method in ("GET", "BREW", "SIP"):
        metrics.request(method, "/jobs", 200, 0.25)
    found = sampled(metrics.exposition())
    assert found["splatfix_requests_total['/jobs', '200', 'GET']"] == 1
    assert found["splatfix_requests_total['/jobs', '200', 'other']"] == 2
    assert found["splatfix_request_seconds_sum['/jobs']"] == 0.75


# ------------------------------------------------------------------ responses


def test_what_may_be_tried_again_says_when():
    for status_code, headers, expected in (
        (429, None, "5"), (503, None, "5"), (503, {"Retry-After": "1"}, "1"), (404, None, None), (500, None, None)
    ):  # fmt: skip
        problem = Problem(type="t", title="t", status=status_code, detail="d", instance="", code="c")
        answer = problem_answer(problem, "/x", headers)
        assert answer.headers.get("retry-after") == expected
        assert answer.status_code == status_code
        assert b'"instance":"/x"' in answer.body


def test_the_document_names_the_headers_of_refusals():
    found = errors("queue_full", "rate_limited", "unauthorized", "job_not_found", always=())
    assert list(found) == [401, 404, 429, 503]
    assert {status: list(response.get("headers", ())) for status, response in found.items()} == {
        401: ["WWW-Authenticate"], 404: [], 429: ["Retry-After"], 503: ["Retry-After"]
    }  # fmt: skip


@pytest.mark.parametrize(("cameras", "bounds", "inside"), [
    ([(1, 2, 3), (3, 4, 5)], None, (2, 3, 4)),
    ([], [[0, 0, 0], [2, 4, 6]], (1, 2, 3)),
    ([], None, (0, 0, 0)),
    (None, None, (0, 0, 0)),
])  # fmt: skip
def test_above_the_floor_is_where_the_cameras_are_else_the_middle(cameras, bounds, inside):
    placed = [
        SimpleNamespace(camera=SimpleNamespace(pose=SimpleNamespace(position_in_world=np.array(c, np.float64))))
        for c in cameras or ()
    ]
    contents = SimpleNamespace(cameras=placed, bounds_in_world=None if bounds is None else np.array(bounds, float))
    engine = SimpleNamespace(contents=lambda scene_id: None if cameras is None else contents)
    assert registrations._inside(SimpleNamespace(engine=engine), "s").tolist() == list(inside)  # type: ignore[arg-type]


# ------------------------------------------------------------------ registering by commands


def registration(determined: tuple[Any, ...] = PARTS, **fields: Any) -> Registration:
    sigma = np.array([np.radians(3), np.radians(4), 0, 3, 4, 12, 0.25])
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    return Registration(matrix, np.zeros(3), np.diag(sigma**2), determined, "", up_in_target=(0, 0, 1), **fields)


def test_a_registration_is_told_with_residuals_and_uncertainty(capsys):
    residuals = (
        Residual("a.jpg", True, 0.01234, 0.456),
        Residual("b.jpg", False, 7.0, None),
        Residual("c.jpg", True, None, 1.0),
    )
    origin = Origin(48.5, 9.25, 431.126)
    found = registration(residuals=residuals, origin=origin, warnings=("beware",), revision=3)
    scenes_register._show(found, Path("registration.json"), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == [
        "a.jpg  used  0.012 m  0.46 degrees", "b.jpg  REJECTED  7.000 m", "c.jpg  used  1.00 degrees",
        "determined: scale, up, heading, position",
    ]  # fmt: skip
    assert "metres per unit: 2 +- 0.5" in lines
    assert "up in the scene: 0.0000 0.0000 1.0000" in lines
    assert "rotation: +- 5 degrees" in lines
    assert "position: +- 13 m at the places' centre" in lines
    assert "origin: 48.5000000 9.2500000, 431.13 m" in lines
    assert lines[-2:] == ["warning: beware", "revision 3, registration.json"]
    scenes_register._show(registration(("scale",)), None, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "determined: scale"
    assert lines[-1] == "not kept (--dry-run)"
    assert not any(line.startswith(("rotation", "position", "origin", "up in")) for line in lines)


def estimates(monkeypatch, *statuses):
    """Let photos be localized at (1, 2, 3), with these statuses; return the queries."""
    asked: list[Any] = []

    def localize(query, loaded):
        asked.append(query)
        status = statuses[len(asked) - 1]
        verdict = SimpleNamespace(status=status, reason=Reason.NO_MATCHING_VIEW, covariance=SPREAD)
        return SimpleNamespace(pose=Pose(TURNED), verdict=verdict)

    for module in ("service.localize", "service.cli.scenes_onto"):
        monkeypatch.setattr(f"{module}.localize", localize)
    return asked


PICTURE = encode_image(np.zeros((480, 640, 3), np.uint8), "png")
SPREAD = np.diag([0.01, 0.02, 0.03, 1.0, 4.0, 9.0])


def test_photos_that_are_not_localized_are_told_by_their_names(monkeypatch, tmp_path):
    asked = estimates(monkeypatch, Status.LOCALIZED, Status.UNCERTAIN, Status.NOT_LOCALIZED)
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / name).write_bytes(encode_image(np.zeros((48, 64, 3), np.uint8), "png"))
    lens, other = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0), Intrinsics(128, 96, 120.0, 120.0, 64.0, 48.0)
    # That of another size is of the photo before it was resized.
    known = [KnownPlace("a.png", intrinsics=lens), KnownPlace("b.png", intrinsics=other), KnownPlace("c.png")]
    loaded: Any = SimpleNamespace(scene=SimpleNamespace(info=SimpleNamespace(background_rgb=(0.0, 0.0, 0.0))))
    found, missed = scenes_register._localized([(place, tmp_path / place.name) for place in known], loaded)
    assert [(one.name, one.place, one.covariance is SPREAD) for one in found] == [("a.png", known[0], True)]
    assert missed == [f"{name} was not localized: no_matching_view." for name in ("b.png", "c.png")]
    assert [query.intrinsics_source for query in asked] == ["given", *[asked[2].intrinsics_source] * 2]
    assert asked[0].intrinsics == lens


def test_renders_of_a_scene_are_places_in_the_other_ones_world(monkeypatch):
    asked = estimates(monkeypatch, *[Status.LOCALIZED, Status.UNCERTAIN] * 3)
    monkeypatch.setattr(scenes_onto, "picture", lambda scene, spec: pictures.append(spec) or PICTURE)
    pictures: list[Any] = []
    camera = Camera(Intrinsics(1280, 960, 1000.0, 1000.0, 640.0, 480.0), Pose(np.eye(4)))
    info = SimpleNamespace(origin_in_world=(100.0, 0.0, 0.0), background_rgb=(0.0,) * 3, up_in_world=(0.0, 1.0, 0.0))
    scene: Any = SimpleNamespace(scene=SimpleNamespace(cameras=[NamedCamera("", camera)] * 5, info=info))
    known, found, missed = scenes_onto.renders_in(scene, scene, 3)
    assert len(asked) == len(pictures) == 3  # every other one
    assert {(spec.intrinsics.width, spec.intrinsics.fx) for spec in pictures} == {(640, 500.0)}
    assert pictures[0].pose.position_in_world.tolist() == [100.0, 0.0, 0.0]
    assert (known.kind, known.up) == ("scene", (0.0, 1.0, 0.0))
    assert missed == ["render 1 was not localized: no_matching_view."]
    assert [one.name for one in found] == ["render 0", "render 2"]
    assert [one.covariance for one in found] == [None, None]
    place = known.places[0]
    assert place.position.tolist() == [1.0, 2.0, 3.0]
    # The camera's axes are turned by a right angle about z; the rotation's sigma is the mean of three variances.
    assert place.covariance == pytest.approx(np.diag([4.0, 1.0, 9.0]))
    assert place.rotation_sigma == pytest.approx(0.02**0.5)


@pytest.mark.parametrize(
    ("known", "unit", "scale"),
    [(None, 0.5, 0.5), ("part", 0.5, 0.5), ("whole", None, 2.0), (None, None, None), ("part", None, None)],
)
def test_a_scene_is_registered_onto_one_that_is_or_whose_unit_is_known(monkeypatch, known, unit, scale):
    info = SceneInfo("s", "s", "0" * 64, "ply", metres_per_unit=unit)
    loaded = SimpleNamespace(scene=SimpleNamespace(info=info))
    registered = {"part": registration(("up",)), "whole": registration()}.get(known)
    monkeypatch.setattr(scenes_onto, "loaded_scene", lambda *_: loaded)
    monkeypatch.setattr(scenes_onto, "scene_registrations", lambda *_: [registered])
    if scale is None:
        with pytest.raises(RegistrationFailed, match="nor is its unit known"):
            scenes_onto.target_of(Path("s"), "xfeat")
        return
    found, target = scenes_onto.target_of(Path("s"), "xfeat")
    assert found is loaded
    assert (target is registered) == (known == "whole")
    assert target.metres_per_unit == pytest.approx(scale)


def test_each_photo_has_one_place(tmp_path):
    known = KnownPlaces("table", (KnownPlace("a/1.jpg"), KnownPlace("b/1.jpg"), KnownPlace("2.jpg")))
    found = scenes_register._place_of(Path("x/a/1.jpg"), known, Path("places.csv"))
    assert found is known.places[0]
    for photo, says in (("1.jpg", "has 2 places"), ("3.jpg", "has no place")):
        with pytest.raises(InvalidRequest, match=f"{says} in places.csv"):
            scenes_register._place_of(Path(photo), known, Path("places.csv"))


def test_photos_lie_beside_their_places_or_in_a_folder_of_pictures(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("1.jpg", "images/2.png", "images/3.jpg"):
        (tmp_path / name).touch()
    (tmp_path.parent / "outside.jpg").touch()
    known = KnownPlaces("table", tuple(map(KnownPlace, ("1.jpg", "2", "3", "4.jpg", "../outside.jpg"))))
    found = scenes_register._beside(known, tmp_path / "places.csv")
    assert [path.relative_to(tmp_path.resolve()).as_posix() for _, path in found] == [
        "1.jpg", "images/2.png", "images/3.jpg"
    ]  # fmt: skip
    assert [place.name for place, _ in scenes_register._beside(known, tmp_path)] == ["1.jpg", "2", "3"]
    with pytest.raises(InvalidRequest, match="none of the photos"):
        scenes_register._beside(KnownPlaces("table", (KnownPlace("4.jpg"),)), tmp_path)


@pytest.mark.parametrize("times", [None, [1.0], [1.0, 2.0, 3.0], 7])
def test_a_trajectory_needs_a_time_for_each_photo(tmp_path, times):
    table = tmp_path / "poses.tum"
    table.write_text("".join(f"{t}.0 {t} 0 0 0 0 0 1\n" for t in range(5)))
    photos = [Path("a.jpg"), Path("b.jpg")]
    with pytest.raises(InvalidRequest, match="needs the times of the 2 photos"):
        scenes_register._known_photos(photos, table, times, None)
    # Neither photos nor a table: points in the scene may be all that is known.
    assert scenes_register._known_photos([], None, times, None) == (KnownPlaces("points", ()), [])
    _, found = scenes_register._known_photos(photos, table, [1.5, 3], None)
    assert [(place.position[0], path.name) for place, path in found if place.position is not None] == [
        (1.5, "a.jpg"), (3.0, "b.jpg")
    ]  # fmt: skip
