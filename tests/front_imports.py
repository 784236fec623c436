"""Imports all that a front of `two_fronts` needs, some of it only when an app is made: once, for all fronts."""

from importlib import import_module

import api_server

api_server.create_app(api_server.settings(estimator="view_index"))
for name in ("service.web.postgres_state", "service.jobs.postgres_store"):
    import_module(name)
