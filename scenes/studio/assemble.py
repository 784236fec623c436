"""Assemble the demo scene's folder from the output of `build.py`: training cameras, photos, truth, manifest.

    python scenes/studio/assemble.py scenes/studio/build

The scene file itself is written by `scenes/train.py`. Training photos stay behind: only their cameras are kept.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
MANIFEST = {"name": "Studio", "up": [0, 0, 1], "metres_per_unit": 1.0, "background": [0, 0, 0]}


def main(build: Path) -> None:
    """Write transforms.json, truth.json, scene.json and photos/ beside this file."""
    transforms = json.loads((build / "transforms.json").read_text())
    training = set(transforms.pop("train_filenames"))
    transforms.pop("test_filenames")
    transforms["frames"] = [frame for frame in transforms["frames"] if frame["file_path"] in training]
    (HERE / "transforms.json").write_text(_one_frame_a_line(transforms))
    (HERE / "scene.json").write_text(json.dumps(MANIFEST, indent=1) + "\n")
    shutil.copy(build / "truth.json", HERE / "truth.json")
    (HERE / "photos").mkdir(exist_ok=True)
    for photo in sorted((build / "photos").glob("*.jpg")):
        shutil.copy(photo, HERE / "photos")
    print(f"{HERE}: {len(training)} training cameras, {len(list((HERE / 'photos').iterdir()))} photos")


def _one_frame_a_line(transforms: dict) -> str:
    head = {key: value for key, value in transforms.items() if key != "frames"}
    frames = ",\n".join(json.dumps(frame) for frame in transforms["frames"])
    return json.dumps(head)[:-1] + ', "frames": [\n' + frames + "\n]}\n"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
