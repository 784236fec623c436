"""Whole methods of localization: one generator function `run(query, tools, options)` a file, and its `Options`.

`run` satisfies `service.interfaces.Estimator`; `prepare(tools, cache_dir)`, where there is one, computes once per scene
what all jobs share.
"""

from service.plugins import PluginRegistry

ESTIMATORS = PluginRegistry("service.estimators", "splatfix.estimators", ("run", "Options"))
