"""ASGI middleware, from the outermost: proxy, route_lookup, authentication, limits."""
