"""Anchors: named points that are kept with a scene, and told by each result as its photo's camera sees them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from api_server import create_app, fake_estimators, finished, post, serving, settings, until
from memory_stores import MemoryAnchorStore
from pyproj import Geod
from test_registration_api import job_at
from test_scenes import TRANSFORMS, ply

from service.client import Client
from service.errors import AnchorNotFound, BadInput, CorruptScene, InvalidRequest
from service.geodesy import utm_from_geographic
from service.geometry import look_at
from service.photos.intrinsics import distorted_pixels
from service.scene_manager.anchor_store import MAX_ANCHORS, Anchor, AnchorStore, FileAnchorStore
from service.scene_manager.status import StoredScene
from service.types import GeoAnchor, Intrinsics
from service.web.schemas.anchors import seen_anchors

PHOTO = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
LOOKING_NORTH = look_at(np.array([1.0, 0.0, 2.0]), np.array([1.0, 5.0, 2.0]), np.array([0.0, 0.0, 1.0]))


@pytest.fixture(params=["file", "memory"])
def store(request, tmp_path) -> AnchorStore:
    (tmp_path / "hall").mkdir()
    if request.param == "memory":
        return MemoryAnchorStore({"hall"})
    scene = StoredScene("hall", tmp_path / "hall")
    return FileAnchorStore(lambda scene_id: scene if scene_id == "hall" else None, tmp_path / "data")


def names(store: AnchorStore) -> list[str]:
    return [anchor.name for anchor in store.anchors("hall")]


def test_anchors_are_added_moved_listed_by_name_and_deleted(store):
    assert isinstance(store, AnchorStore)
    assert store.anchors("hall") == ()
    for name in ("window", "door 1", "Tür"):
        store.put("hall", Anchor(name, np.array([1.0, 2.0, 3.0])))
    assert names(store) == ["Tür", "door 1", "window"]
    store.put("hall", Anchor("window", np.array([0.1, 0.2, 0.3])))
    np.testing.assert_array_equal(store.anchors("hall")[2].position_in_world, [0.1, 0.2, 0.3])
    store.delete("hall", "door 1")
    assert names(store) == ["Tür", "window"]
    with pytest.raises(AnchorNotFound, match="'door 1' not found"):
        store.delete("hall", "door 1")


def test_a_scene_that_is_not_known_has_no_anchors_and_gets_none(store):
    assert store.anchors("attic") == ()
    with pytest.raises(BadInput):
        store.put("attic", Anchor("a", np.zeros(3)))
    with pytest.raises(AnchorNotFound):
        store.delete("attic", "a")


def test_what_is_no_point_is_refused():
    for position in ([1.0, 2.0], [1.0, 2.0, np.nan], [np.inf, 0, 0]):
        with pytest.raises(InvalidRequest, match="three finite numbers"):
            Anchor("a", np.array(position))


def test_the_file_outlives_the_store_and_its_number_is_bounded(tmp_path, monkeypatch):
    (tmp_path / "hall.ply").write_bytes(b"")
    scene = StoredScene("hall", tmp_path / "hall.ply")
    FileAnchorStore(lambda _: scene, None).put("hall", Anchor("a", np.ones(3)))
    again = FileAnchorStore(lambda _: scene, None)
    assert names(again) == ["a"]
    assert (tmp_path / "hall.anchors.json").is_file()
    monkeypatch.setattr("service.scene_manager.anchor_store.MAX_ANCHORS", 2)
    again.put("hall", Anchor("b", np.ones(3)))
    again.put("hall", Anchor("b", np.zeros(3)))  # moved, not added
    with pytest.raises(BadInput, match="at most 2 anchors"):
        again.put("hall", Anchor("c", np.ones(3)))
    assert MAX_ANCHORS == 1000
    (tmp_path / "hall.anchors.json").write_text("{")
    with pytest.raises(CorruptScene, match=r"hall\.anchors\.json: no anchors can be read"):
        again.anchors("hall")


def test_where_the_scene_is_read_only_the_data_folder_has_them(tmp_path, monkeypatch):
    from service.scene_formats import side_file

    replace_file = side_file._replace

    def refuse(path: Path, text: str) -> None:
        if path.parent == tmp_path / "hall":
            raise OSError(30, "Read-only file system")
        replace_file(path, text)

    monkeypatch.setattr(side_file, "_replace", refuse)
    (tmp_path / "hall").mkdir()
    scene = StoredScene("hall", tmp_path / "hall")
    store = FileAnchorStore(lambda _: scene, tmp_path / "data")
    store.put("hall", Anchor("a", np.ones(3)))
    assert names(store) == ["a"]
    assert len(list((tmp_path / "data" / "anchors").iterdir())) == 1


# ------------------------------------------------------------------ as a camera sees them


def test_an_anchor_is_seen_where_the_camera_model_says():
    # 4 ahead, 1 to the right, 0.5 up, from (1, 0, 2) looking along +y.
    points = [Anchor("lamp", np.array([2.0, 4.0, 2.5])), Anchor("behind", np.array([1.0, -3.0, 2.0]))]
    lamp, behind = seen_anchors(points, LOOKING_NORTH, PHOTO, None)
    np.testing.assert_allclose(lamp.in_camera, [1.0, -0.5, 4.0], atol=1e-12)
    np.testing.assert_allclose(lamp.pixel or [], [320 + 500 / 4, 240 - 500 / 8], atol=1e-9)
    assert lamp.position == [2.0, 4.0, 2.5]
    assert lamp.geographic is None
    assert behind.in_camera[2] == pytest.approx(-3.0)
    assert behind.pixel is None
    (beside,) = seen_anchors([Anchor("beside", np.array([9.0, 1.0, 2.0]))], LOOKING_NORTH, PHOTO, None)
    assert beside.pixel is None


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_pixels_have_the_lens_distortion(model: str) -> None:
    """Against COLMAP's formulas, written out."""
    k = {"SIMPLE_RADIAL": (-0.1,), "OPENCV": (-0.1, 0.02, 0.001, -0.002), "OPENCV_FISHEYE": (0.01, 0.002, 0.0, 0.0)}
    lens = Intrinsics(640, 480, 500.0, 510.0, 321.0, 239.0, model, k[model])
    x, y = 0.4, -0.25
    r2 = x * x + y * y
    if model == "SIMPLE_RADIAL":
        u, v = x * (1 - 0.1 * r2), y * (1 - 0.1 * r2)
    elif model == "OPENCV":
        radial, p1, p2 = 1 - 0.1 * r2 + 0.02 * r2**2, 0.001, -0.002
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    else:
        angle = np.arctan(np.sqrt(r2))
        factor = angle * (1 + 0.01 * angle**2 + 0.002 * angle**4) / np.sqrt(r2)
        u, v = x * factor, y * factor
    expected = [500 * u + 321, 510 * v + 239]
    np.testing.assert_allclose(distorted_pixels(np.array([[3 * x, 3 * y, 3.0]]), lens)[0], expected, atol=1e-6)


def test_an_anchor_on_earth_is_as_far_and_where_geodesy_says():
    """Metres per unit 0.5, east along y: 4 units to y are 2 m east."""
    enu_from_world = np.diag([0.5, 0.5, 0.5, 1.0])
    enu_from_world[:3, :3] = 0.5 * np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    place = GeoAnchor(47.3, 8.5, 450.0, enu_from_world)
    (seen,) = seen_anchors([Anchor("lamp", np.array([0.0, 4.0, 2.0]))], LOOKING_NORTH, PHOTO, place)
    assert seen.geographic
    azimuth, _, distance = Geod(ellps="WGS84").inv(8.5, 47.3, seen.geographic.longitude, seen.geographic.latitude)
    assert azimuth == pytest.approx(90, abs=1e-3)
    assert distance == pytest.approx(2.0, abs=1e-3)
    assert seen.geographic.height == pytest.approx(451, abs=1e-3)
    assert seen.geographic.utm_zone == "32N"


def test_utm_is_that_of_known_places():
    """By Snyder's series for the transverse Mercator projection, to a decimetre."""
    for latitude, longitude, zone in ((47.3, 8.5, "32N"), (-33.9, 151.2, "56S"), (0.0, -180.0, "1N")):
        found, easting, northing = utm_from_geographic(latitude, longitude)
        assert found == zone
        east, north = snyder(latitude, longitude, 6 * int(zone[:-1]) - 183)
        assert easting == pytest.approx(east, abs=0.1)
        assert northing == pytest.approx(north + (10_000_000 if zone.endswith("S") else 0), abs=0.1)


def snyder(latitude: float, longitude: float, meridian: float) -> tuple[float, float]:
    """Snyder, "Map projections: a working manual", 1987, equations 8-9 and 8-10 for the ellipsoid."""
    a, e2, k0 = 6378137.0, 0.00669437999014, 0.9996
    phi, ep2 = np.radians(latitude), e2 / (1 - e2)
    n, t, c = a / np.sqrt(1 - e2 * np.sin(phi) ** 2), np.tan(phi) ** 2, ep2 * np.cos(phi) ** 2
    arc = np.radians(longitude - meridian) * np.cos(phi)
    m = a * (
        (1 - e2 / 4 - 3 * e2**2 / 64 - 5 * e2**3 / 256) * phi
        - (3 * e2 / 8 + 3 * e2**2 / 32 + 45 * e2**3 / 1024) * np.sin(2 * phi)
        + (15 * e2**2 / 256 + 45 * e2**3 / 1024) * np.sin(4 * phi)
        - (35 * e2**3 / 3072) * np.sin(6 * phi)
    )
    east = arc + (1 - t + c) * arc**3 / 6 + (5 - 18 * t + t**2 + 72 * c - 58 * ep2) * arc**5 / 120
    north = arc**2 / 2 + (5 - t + 9 * c + 4 * c**2) * arc**4 / 24
    north += (61 - 58 * t + t**2 + 600 * c - 330 * ep2) * arc**6 / 720
    return k0 * n * east + 500_000, k0 * (m + n * np.tan(phi) * north)


# ------------------------------------------------------------------ over HTTP


@pytest.fixture(scope="module")
def service(tmp_path_factory) -> Iterator[SimpleNamespace]:
    folder = tmp_path_factory.mktemp("anchored")
    scene = folder / "hall"
    scene.mkdir()
    (scene / "scene.ply").write_bytes(ply(50))
    (scene / "transforms.json").write_text(json.dumps(TRANSFORMS))
    with fake_estimators() as stepping:
        app = create_app(settings(scenes=[scene], cache_dir=None, data_dir=folder / "data"))
        with serving(app) as client:
            until(lambda: client.get("/readyz").json()["ready"], 100)
            stepping.GO_ON.set()
            yield SimpleNamespace(client=client, app=app, scene=scene)
    stepping.GO_ON.clear()


def test_results_have_the_anchors_of_now(service):
    client = service.client
    assert client.get("/scenes/hall/anchors").json() == {"anchors": []}
    job = job_at(service, LOOKING_NORTH, 1)
    assert client.get(f"/jobs/{job}").json()["result"]["anchors"] == []
    put = client.put("/scenes/hall/anchors/the%20lamp", json={"position": [2, 4, 2.5]})
    assert put.json() == {"name": "the lamp", "position": [2, 4, 2.5]}
    (seen,) = client.get(f"/jobs/{job}").json()["result"]["anchors"]
    assert seen["name"] == "the lamp"
    np.testing.assert_allclose(seen["in_camera"], [1.0, -0.5, 4.0], atol=1e-9)
    # A photo that isn't localized sees nothing.
    lost = post(client, scene="hall", seed="2").json()["id"]
    assert finished(client, f"/jobs/{lost}")["result"]["anchors"] == []
    assert client.delete("/scenes/hall/anchors/the%20lamp").status_code == 204
    assert client.get(f"/jobs/{job}").json()["result"]["anchors"] == []


def test_a_damaged_file_of_anchors_costs_no_result(service):
    job = job_at(service, LOOKING_NORTH, 3)
    file = service.scene / "anchors.json"
    file.write_text("{")
    assert service.client.get(f"/jobs/{job}").json()["result"]["anchors"] == []
    assert service.client.get("/scenes/hall/anchors").json()["code"] == "corrupt_scene"
    file.unlink()


def test_the_python_client_names_points(service):
    client = Client(str(service.client.base_url), use_proxy=False)
    client.put_anchor("hall", "Tür 1?", [1, 2, 3])
    np.testing.assert_array_equal(client.anchors("hall")["Tür 1?"], [1, 2, 3])
    client.delete_anchor("hall", "Tür 1?")
    assert client.anchors("hall") == {}
    client.close()
