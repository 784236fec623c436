"""Renderers of Gaussian scenes: `create(scene) -> Rasterizer` (see `service.interfaces`) in a file each."""

from service.plugins import PluginRegistry

RASTERIZERS = PluginRegistry("service.render", "splatfix.rasterizers", ("create",))
