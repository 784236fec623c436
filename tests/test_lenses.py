"""The memory of lenses: simulated cameras whose lenses are known, and what every store promises."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from postgres_server import POSTGRES

from service.geometry import look_at
from service.jobs.sqlite_lens_store import SqliteLensStore
from service.lenses.lens_estimate import LENS_MEMORY, LensEstimate, LensMeasurement, Viewpoint, updated
from service.lenses.lens_key import LensKey, lens_key
from service.lenses.lens_store import LensStore, MemoryLensStore
from service.photos.camera_identity import CameraIdentity

PHONE = CameraIdentity(4032, 3024, make="Apple", model="iPhone 12", focal_length_mm=4.2, focal_35mm=26.0)
UNKNOWN = (np.inf, np.inf)


def viewpoint(angle_deg: float, scene: str = "s", radius: float = 4.0) -> Viewpoint:
    """On a circle, looking at its centre."""
    angle = np.radians(angle_deg)
    at = radius * np.array([np.cos(angle), np.sin(angle), 0.2])
    return Viewpoint(scene, look_at(at, np.zeros(3), np.array([0.0, 0.0, 1.0])), radius)


def measurement(
    log_focal: float, k1: float = 0.0, sigma: float = 0.004, k1_sigma: float = 0.005, angle_deg: float = 0.0, **where
) -> LensMeasurement:
    values = (log_focal, k1, 0.0, 0.0)
    return LensMeasurement(values, (sigma, k1_sigma, *UNKNOWN), viewpoint(angle_deg, **where))


# ------------------------------------------------------------------ keys


def test_photos_of_one_lens_have_one_key():
    key = lens_key("me", None, PHONE)
    assert key is not None
    held_upright = replace(PHONE, orientation=6)
    stored_upright, resized = replace(PHONE, width=3024, height=4032), replace(PHONE, width=1600, height=1200)
    assert {lens_key("me", None, camera) for camera in (held_upright, stored_upright, resized)} == {key}
    assert len(key.id) == 16


@pytest.mark.parametrize(
    "change",
    [
        {"make": "Google"}, {"model": "iPhone 13"}, {"lens_model": "ultra wide"}, {"focal_length_mm": 1.5},
        {"focal_35mm": 13.0}, {"digital_zoom": 2.0}, {"height": 2268}, {"is_video": True},
    ],
)  # fmt: skip
def test_another_camera_or_setting_has_another_key(change):
    keys = [lens_key("me", None, PHONE), lens_key("me", None, replace(PHONE, **change))]
    assert keys[0] != keys[1]
    assert keys[0].id != keys[1].id


def test_other_owners_and_names_have_other_keys():
    keys = [lens_key(owner, name, PHONE) for owner in ("me", "you") for name in (None, "left", "right")]
    assert len({key.id for key in keys}) == 6


def test_what_nothing_names_or_what_was_cropped_has_no_key():
    assert lens_key("me", None, CameraIdentity(4032, 3024, focal_35mm=26.0)) is None
    assert lens_key("me", "left", CameraIdentity(4032, 3024)) is not None
    cropped = replace(PHONE, width=3024, exif_width=4032, exif_height=3024)
    assert lens_key("me", None, cropped) is None
    assert lens_key("me", "left", cropped) is None


# ------------------------------------------------------------------ estimates


def taught(measurements: list[LensMeasurement]) -> LensEstimate:
    estimate = None
    for found in measurements:
        estimate = updated(estimate, found)
    assert estimate is not None
    return estimate


def test_the_first_photo_is_believed_with_the_scatter_of_photos():
    estimate = updated(None, measurement(-0.3, -0.08))
    assert estimate.mean == (-0.3, -0.08, 0.0, 0.0)
    assert estimate.sigma[:2] == pytest.approx((np.hypot(0.004, 0.007), np.hypot(0.005, 0.003)))
    assert (estimate.photos, estimate.viewpoints, estimate.is_tested()) == (1, 1, False)
    # Untested: wide.
    assert estimate.prior_sigma() == pytest.approx((0.03, 0.02, 2 * np.hypot(1, 0.005), 2 * np.hypot(1, 0.005)))


def test_two_photos_are_the_mean_weighted_by_their_variances():
    estimate = taught([measurement(-0.3, sigma=0.003), measurement(-0.29, sigma=0.006, angle_deg=20)])
    # By least squares, written out: one unknown, two measurements with the photos' own scatter.
    variance = np.array([0.003, 0.006]) ** 2 + 0.007**2
    assert estimate.mean[0] == pytest.approx(np.sum([-0.3, -0.29] / variance) / np.sum(1 / variance))
    assert estimate.sigma[0] == pytest.approx(np.sum(1 / variance) ** -0.5)
    assert estimate.is_tested()
    assert estimate.prior_sigma()[0] == pytest.approx(np.hypot(estimate.sigma[0], 0.007))


def test_the_prior_holds_the_next_photos_lens_as_often_as_it_says():
    """80 cameras with 12 photos each: the lens of the next one lies within 1 and 2 sigma in 68 and 95 %."""
    rng = np.random.default_rng(0)
    z: list[float] = []
    for _ in range(80):
        camera, estimate = rng.normal([-0.3, -0.05], [0.1, 0.05]), None
        for k in range(12):
            lens = camera + rng.normal(0, LENS_MEMORY.photo_sigma[:2])
            if estimate is not None and estimate.is_tested():
                z.extend((lens - estimate.mean[:2]) / estimate.prior_sigma()[:2])
            sigma = rng.uniform(0.001, 0.008, 2)
            seen = lens + rng.normal(0, sigma)
            estimate = updated(estimate, measurement(*seen, *sigma, angle_deg=20 * k))
    within = [float(np.mean(np.abs(z) < bound)) for bound in (1, 2)]
    # Seen: 0.69 and 0.96, of 1600.
    assert 0.64 < within[0] < 0.74
    assert 0.93 < within[1] < 0.985


def test_photos_from_one_place_count_once():
    first = measurement(-0.3)
    estimate = taught([first] * 5 + [measurement(-0.302, angle_deg=2.0)])
    assert estimate == updated(None, first)
    for elsewhere in ({"angle_deg": 6.0}, {"angle_deg": 0.0, "scene": "other"}, {"angle_deg": 0.0, "radius": 3.0}):
        assert taught([first, measurement(-0.302, **elsewhere)]).is_tested()


def test_without_a_known_distance_only_rotation_tells_viewpoints_apart():
    near, far = replace(viewpoint(0), distance=np.inf), replace(viewpoint(0, radius=3.0), distance=np.inf)
    assert not near.differs(far)
    assert near.differs(replace(viewpoint(10), distance=np.inf))


def test_a_contradiction_is_not_averaged():
    settled = taught([measurement(-0.3 + 0.002 * (k % 3), angle_deg=20 * k) for k in range(6)])
    mean = settled.mean[0]
    # A lens that was zoomed, or a wrong answer.
    doubted = updated(settled, measurement(0.1, angle_deg=200))
    assert doubted.mean[0] == mean
    assert doubted.prior_sigma()[0] > 0.4
    assert not doubted.is_tested()
    # It was a wrong answer: the memory is as before.
    restored = taught_after(doubted, -0.3, 3)
    assert restored.mean[0] == pytest.approx(mean, abs=0.005)
    assert restored.is_tested()
    # The camera has another lens: nothing is left of the old one.
    moved = taught_after(doubted, 0.1, 3)
    assert moved.mean[0] == pytest.approx(0.1, abs=0.002)
    assert moved.is_tested()
    assert moved.prior_sigma()[0] < 0.02


def taught_after(estimate: LensEstimate, log_focal: float, count: int) -> LensEstimate:
    for k in range(count):
        estimate = updated(estimate, measurement(log_focal, angle_deg=220 + 20 * k))
    return estimate


def test_a_distortion_that_contradicts_widens_the_distortion_alone():
    settled = taught([measurement(-0.3, -0.05, angle_deg=20 * k) for k in range(4)])
    doubted = updated(settled, measurement(-0.3, 0.05, angle_deg=200))
    assert doubted.sigma[1] > 0.09
    assert doubted.sigma[0] == settled.sigma[0]
    assert not doubted.is_tested()


def test_an_old_estimate_still_follows():
    """After 300 photos a lens that has changed by 1.5 % is found again within 60."""
    estimate = taught([measurement(-0.3, angle_deg=20 * k) for k in range(300)])
    later = taught_after(estimate, -0.285, 60)
    assert later.mean[0] == pytest.approx(-0.285, abs=0.002)


def test_what_was_not_measured_stays():
    estimate = updated(updated(None, measurement(-0.3, -0.05)), measurement(-0.3, 9.0, k1_sigma=np.inf, angle_deg=20))
    assert estimate.mean[1] == -0.05
    assert estimate.is_tested()


# ------------------------------------------------------------------ stores


@pytest.fixture(params=["sqlite", "memory", POSTGRES])
def store(request, tmp_path) -> Iterator[LensStore]:
    if request.param == "postgres":
        database = request.getfixturevalue("database")
        from service.jobs.postgres_store import PostgresLensStore

        made: LensStore = PostgresLensStore(database, 3)
    else:
        made = SqliteLensStore(tmp_path / "lenses.sqlite", 3) if request.param == "sqlite" else MemoryLensStore(3)
    assert isinstance(made, LensStore)
    yield made
    made.close()


def key_of(name: str, owner: str = "me") -> LensKey:
    key = lens_key(owner, name, PHONE)
    assert key is not None
    return key


def put(store: LensStore, name: str, owner: str = "me", log_focal: float = -0.3) -> LensKey:
    key = key_of(name, owner)
    # Each from another viewpoint.
    store.change(key, lambda k: updated(k, measurement(log_focal, angle_deg=20.0 * (k.photos if k else 0))))
    return key


def test_a_lens_comes_back_as_it_was(store):
    key = put(store, "a", log_focal=-0.3 + 1e-15)
    found = store.find(key.id)
    assert found.key == key
    assert found.estimate.mean == (-0.3 + 1e-15, 0.0, 0.0, 0.0)
    assert np.array_equal(found.estimate.viewpoint.pose.world_from_camera, viewpoint(0).pose.world_from_camera)
    assert found.estimate.viewpoint.distance == 4.0
    assert store.find(key_of("b").id) is None
    put(store, "a")
    assert (store.find(key.id).estimate.photos, store.find(key.id).estimate.is_tested()) == (2, True)
    assert store.find(key.id).updated >= found.updated


def test_the_lens_unchanged_for_longest_makes_room(store):
    for name in ("a", "b", "c"):
        put(store, name)
    put(store, "a")
    put(store, "d")
    assert [lens.key.camera_id for lens in store.lenses()] == ["d", "a", "c"]


def test_owners_see_and_delete_their_own(store):
    mine, yours = put(store, "a"), put(store, "a", "you")
    put(store, "b", "you")
    assert [lens.key for lens in store.lenses("me")] == [mine]
    assert [lens.key.camera_id for lens in store.lenses("you")] == ["b", "a"]
    assert store.lenses("nobody") == []
    assert store.delete(yours.id, "me") == 0
    assert store.delete(yours.id, "you") == 1
    assert store.delete(yours.id) == 0
    assert store.delete(owner="you") == 1
    assert [lens.key for lens in store.lenses()] == [mine]
    assert store.delete() == 1
    assert store.lenses() == []


def test_a_change_that_fails_changes_nothing(store):
    key = put(store, "a")
    before = store.find(key.id)

    def fail(known: LensEstimate | None) -> LensEstimate:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        store.change(key, fail)
    assert [lens.estimate.photos for lens in store.lenses()] == [1]
    assert store.find(key.id).updated == before.updated


def test_threads_lose_no_change(store):
    threads = [threading.Thread(target=put, args=(store, "a")) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.find(key_of("a").id).estimate.photos == 8


def test_lenses_on_disk_survive_and_a_lower_limit_holds_at_once(tmp_path):
    path = tmp_path / "lenses.sqlite"
    store = SqliteLensStore(path, 3)
    for name in ("a", "b", "c"):
        put(store, name)
    store.close()
    for limit, left in ((2, ["c", "b"]), (0, [])):
        store = SqliteLensStore(path, limit)
        assert [lens.key.camera_id for lens in store.lenses()] == left
        store.close()
