"""What a single image provides: the photo's copies and features, and a render with its features at scene points.

`query_images` holds everything that is computed from the photo alone; `rendered_views` renders the scene and
backprojects features; `in_plane_rotation` estimates how a photo is rotated; `mirrored_query` mirrors one; `row_motion`
takes a rolling shutter's motion out of one; `unknown_background` tells by a photo's border what is behind a scene;
`image_sizes` has the sizes that photos and renders are compared at; `scene_focus` is the point that a scene's cameras
look at.
"""
