"""Where in a scene a photo would be found, and how well: the coverage map.

`plan`: the plan view, and where photos of the scene may be taken. `degraded_renders`: renders made as photos are.
`measurement`: localizes such photos, and held-out real ones. `calibration`: from renders to real photos.
`coverage_map`: the result. `coverage_cache`: keeps it beside the view index. `plan_drawing`: draws it.
`scene_drawing`: draws a scene from above, and renders of it.
"""
