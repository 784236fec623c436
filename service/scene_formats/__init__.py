"""Files and folders on disk -> GaussianScene.

A format is a file in this folder with `accepts(head, suffix) -> bool` and `read(path) -> RawGaussians`;
`folder` has `load_scene`, which finds the reader, checks what it read, and adds the manifest and the
training cameras.
"""

from service.scene_formats.folder import SCENE_FORMATS, load_scene

__all__ = ["SCENE_FORMATS", "load_scene"]
