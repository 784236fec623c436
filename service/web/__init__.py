"""The HTTP service: `app` assembles it from settings, middleware, routes and the viewer's relay.

    request -> proxy -> route_lookup -> authentication -> limits -> route -> schemas: values in, JSON out

What a route allows is declared on it (`route_policy`), and enforced before its body is read (`middleware`). Every error
is answered with a problem document (`problems`). Jobs and scenes themselves know no HTTP: `service.jobs`,
`service.scene_manager`.
"""
