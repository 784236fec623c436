"""Random combinations of lens, photo and scene for `splatfix bench field`: what no list of rows thinks of."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from service.bench.field_rows import Row, Told
from service.bench.modifications import MODIFICATIONS
from service.types import Intrinsics

Draw = Callable[[np.random.Generator], float]


def _between(low: float, high: float) -> Draw:
    return lambda rng: round(float(rng.uniform(low, high)), 3)


def _one_of(*values: float) -> Draw:
    return lambda rng: values[int(rng.integers(len(values)))]


NO_LENS = 0.3
"""Share of combinations whose lens remains a pinhole."""
BENT: Mapping[str, tuple[float, Draw]] = {
    "k1": (0.7, _between(-0.1, 0.1)),
    "fisheye": (0.1, _one_of(1)),
    "shutter_yaw": (0.1, _between(-30, 30)),
    "shutter_pitch": (0.1, _between(-30, 30)),
}
"""How often each occurs among the other combinations, and its values."""
CUT: Mapping[str, tuple[float, Draw]] = {
    "": (0.6, _one_of(0)),
    "crop": (0.15, _between(0.5, 0.95)),
    "off_centre": (0.15, _between(0.6, 0.95)),
    "zoom": (0.1, _between(1.1, 2.5)),
}
PIXELS: Mapping[str, Draw] = {
    "vignetting": _between(0.1, 0.8),
    "local_light": _between(0.2, 1.0),
    "colour_cast": _between(0.05, 0.4),
    "gain": _between(0.6, 1.6),
    "gamma": _between(0.6, 1.6),
    "white_balance": _between(0.8, 1.25),
    "saturation": _between(0, 1.5),
    "motion_blur": _between(1, 8),
    "blur": _between(0.5, 4),
    "phone_noise": _between(0.01, 0.15),
    "noise": _between(0.01, 0.1),
    "scale": _between(0.3, 1),
    "jpeg": _between(15, 90),
    "letterbox": _between(0.1, 0.4),
    "white_bars": _between(0.05, 0.2),
    "occlusion": _between(0.05, 0.35),
}
"""In the order in which light, camera, program and screen change a photo."""
PIXELS_COUNT = (0.2, 0.4, 0.3, 0.1)
"""How often none, one, two and three of them occur together."""
ROLLED = 0.15
"""Share of photos rolled by a quarter or half turn, before all else."""
SCENES = ("sh_degree=0", "splat=1", "spz=1", "sog=1", "thin=0.5", "soft=0.33", "floaters=1", "hole=0.125", "warm=1",
          "dark=0.5")  # fmt: skip
OTHER_SCENE = 0.25
"""Share of combinations in a modified scene."""
TELLING: Mapping[Told, float] = {
    "told": 0.3,
    "exif": 0.3,
    "withheld": 0.2,
    "approximate": 0.1,
    "pinhole": 0.07,
    "centred": 0.03,
}
WRONG_FOCAL = 0.25
"""Share of what is told or in EXIF whose focal length is up to a tenth off."""


def random_row(rng: np.random.Generator, lens: Intrinsics) -> Row:
    """Draw a combination for a photo with this lens; the name says only what is told of it.

    Whatever is drawn fits the photo: one that is distorted already isn't bent once more.
    """
    pinhole = lens.model in ("PINHOLE", "SIMPLE_PINHOLE")
    bent = _one(rng, BENT) if rng.random() > NO_LENS else []
    rolled = [f"roll={(-90, 90, 180)[int(rng.integers(3))]}"] if rng.random() < ROLLED else []
    geometry = [*(rolled + bent if pinhole else []), *_one(rng, CUT)]
    chosen = rng.permutation(list(PIXELS))[: rng.choice(len(PIXELS_COUNT), p=PIXELS_COUNT)]
    pixels = [f"{name}={draw(rng):g}" for name, draw in PIXELS.items() if name in chosen]
    told: Told = list(TELLING)[rng.choice(len(TELLING), p=list(TELLING.values()))]
    # Nothing to conceal of a lens without distortion.
    if told == "pinhole" and pinhole and not bent:
        told = "told"
    if told != "withheld" and rng.random() < WRONG_FOCAL:
        geometry.append(f"focal={rng.uniform(0.9, 1.1):.3f}")
    scene = (SCENES[int(rng.integers(len(SCENES)))],) if rng.random() < OTHER_SCENE else ()
    return Row(f"random/{told}", told, (*geometry, *pixels), scene)


def _one(rng: np.random.Generator, choices: Mapping[str, tuple[float, Draw]]) -> list[str]:
    """Draw one modification; none where its name is empty."""
    names = list(choices)
    name = names[rng.choice(len(names), p=[share for share, _ in choices.values()])]
    value = choices[name][1](rng)
    return [f"{name}={value:g}"] if name in MODIFICATIONS else []
