from service.plugins import PluginFolder

MATCHERS = PluginFolder("service.matchers", "create")
