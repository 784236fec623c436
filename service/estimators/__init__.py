from service.plugins import PluginFolder

ESTIMATORS = PluginFolder("service.estimators", "run")
