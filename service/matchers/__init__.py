"""Local features and their matching: `create() -> Matcher | ImageMatcher` (see `service.interfaces`) in a file each."""

from service.plugins import PluginRegistry

MATCHERS = PluginRegistry("service.matchers", "splatfix.matchers", ("create",))
