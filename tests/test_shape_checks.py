"""Wrong shapes and types are noticed, in a module of the tests' own and in the packages."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
import shape_checks
from shape_checks import ShapeError

from service.geometry import hat
from service.interfaces import Frame

SOURCE = """
from __future__ import annotations
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal
import numpy as np
from jaxtyping import Float32, Float64
from service.jit import kernel

def distances(
    a: Float32[np.ndarray, "n 3"], b: Float32[np.ndarray, "n 3"], all: bool = False
) -> Float32[np.ndarray, "n"]:
    found = ((a - b) ** 2).sum(1)
    return found if all else found[1:]

def sizes(images: list[Float32[np.ndarray, "_ _"]]) -> tuple[Later, Float64[np.ndarray, "2"]]:
    return Later(), np.zeros(2)

def halves(image: Float32[np.ndarray, "h w"]) -> Iterator[Float32[np.ndarray, "_ w"]]:
    yield from np.split(image, 2)

@kernel
def total(values: Float32[np.ndarray, "n"]) -> float:
    return values[0] + values[1]

@dataclass(frozen=True, slots=True)
class Track:
    times: Float64[np.ndarray, "n"]
    places: Float64[np.ndarray, "n 3"] | None = None
    note: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", np.asarray(self.times, np.float64))

    @property
    def first(self) -> Float64[np.ndarray, "3"]:
        return self.times[:1]

    @classmethod
    def at(cls, place: Float64[np.ndarray, "3"]) -> Track:
        return cls(np.zeros(1), place[None])

class Later:
    pass
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    path = tmp_path_factory.mktemp("toy") / "toy.py"
    path.write_text(SOURCE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)
        spec = shape_checks.Finder(["toy"]).find_spec("toy")
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, "toy", module)
        spec.loader.exec_module(module)
        yield module


def zeros(*shape: int, dtype: type = np.float32) -> np.ndarray:
    return np.zeros(shape, dtype)


def test_right_shapes_pass(toy):
    assert toy.distances(zeros(4, 3), b=zeros(4, 3), all=True).shape == (4,)
    assert toy.sizes([zeros(2, 3), zeros(4, 5)])[1].shape == (2,)
    assert [half.shape for half in toy.halves(zeros(4, 2))] == [(2, 2)] * 2
    assert toy.Track([1, 2], None, note="unchecked").times.dtype == np.float64  # fields count as they are stored
    assert toy.Track.at(zeros(3, dtype=np.float64)).places.shape == (1, 3)


def test_a_compiled_kernel_stays_as_it_is(toy):
    assert toy.total(zeros(2)) == 0
    assert toy.total.py_func(zeros(2, 2)).shape == (2,)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda toy: toy.distances(zeros(4, 2), zeros(4, 2)), "toy.distances: a is float32 (4, 2)"),
        (lambda toy: toy.distances(zeros(4, 3), zeros(5, 3)), "toy.distances: b is float32 (5, 3)"),
        (lambda toy: toy.distances(zeros(4, 3), b=zeros(4, 3, dtype=float)), "b is float64 (4, 3)"),
        (lambda toy: toy.distances(zeros(4, 3), zeros(4, 3)), "toy.distances: return is float32 (3,)"),
        (lambda toy: toy.sizes([zeros(2, 2)] * 50 + [zeros(2)]), "toy.sizes: images is <class 'list'>"),
        (lambda toy: list(toy.halves(zeros(4))), "toy.halves: image is float32 (4,)"),
        (lambda toy: toy.Track(np.zeros(2), np.zeros((3, 3))), "toy.Track: places is float64 (3, 3)"),
        (lambda toy: toy.Track(np.zeros(2)).first, "toy.Track.first: return is float64 (1,)"),
        (lambda toy: toy.Track.at(np.zeros(4)), "toy.Track.at: place is float64 (4,)"),
        (lambda _: hat(np.zeros(4)), "service.geometry.hat"),
        (lambda _: Frame(zeros(2, 2, 3), zeros(2, 2), zeros(2, 3), zeros(2, 2)), "service.interfaces.Frame"),
    ],
)
def test_a_wrong_shape_is_noticed(toy, wrong, named):
    with pytest.raises(ShapeError) as error:
        wrong(toy)
    assert named in str(error.value)


def test_what_is_imported_already_can_not_be_checked():
    with pytest.raises(AssertionError, match="too late"):
        shape_checks.install(["service"])
