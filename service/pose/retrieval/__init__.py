"""Image retrieval in a scene: an index of rendered views, and scores of how much each is like a photo.

`index` renders the views and stores them; `viewpoints` chooses where from, for a scene without cameras with
`view_placement` in the `free_space`, before the `outer_planes`; `free_views` are further ones, for photos that are like
none of these; `view_files` stores both; `floaters` are left out of all renders; `lod_proxy` speeds up those of large
scenes. `image_variant` compares a photo, in several sizes and rotations, by the `scores`, of many views those of
`inverted_views`. `scene_symmetries` and `ambiguous_hypotheses` find out what else a photo may show.
"""
