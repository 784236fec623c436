from service.plugins import PluginFolder

SCENE_FORMATS = PluginFolder("service.scene_formats", "read")
