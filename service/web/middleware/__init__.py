"""ASGI middleware: what a request passes before its route reads the body. From the outermost:

    proxy            sub-path of a reverse proxy, request id, security headers, log, slow readers
    head_requests    HEAD is answered by the route for GET
    (CORS)           Starlette's, where other sites are allowed
    route_lookup     finds the route, with its policy and the scene that the path names
    authentication   refuses by host, origin, key, role and scene: 401, 403, 404
    limits           refuses by rate, size, queue and uploads under way: 429, 413, 503; then counts and times the body

`service/web/app.py` stacks them; `service/web/route_policy.py` has what each route declares.
"""
