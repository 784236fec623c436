"""Localization against the training photos by structure from motion, the usual alternative, beside ours.

`colmap` wraps pycolmap: features, triangulation, absolute pose. `photo_matching` pairs features of two photos, `words`
ranks photos by bags of words, `photo_map` is what is kept of the training photos and localizes by it. `comparison`
measures it and our own estimator on the same photos.
"""
