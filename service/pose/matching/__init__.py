"""2D-3D correspondences: a photo's features matched with those of rendered views, whose scene points are known.

`correspondences` matches with one view, `render_and_match` with a render made for it; `match_stages` are the stages of
a search that match candidate views, and again with a render at the pose found, and solve for the pose each time.
"""
