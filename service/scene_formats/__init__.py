"""Files and folders on disk -> GaussianScene.

A format is a file in this folder with `SUFFIXES`, `accepts(head, suffix) -> bool` and `read(path) -> RawGaussians`;
`formats` has their registry, `folder` has `load_scene`, which finds the reader, checks what it read, and adds the
manifest and the training cameras.
"""

from service.scene_formats.folder import load_scene
from service.scene_formats.formats import SCENE_FORMATS

__all__ = ["SCENE_FORMATS", "load_scene"]
