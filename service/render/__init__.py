from service.plugins import PluginFolder

RASTERIZERS = PluginFolder("service.render", "create")
