"""Training photos as evidence: scene points that several of them show, and the pose of a photo that shows them, too.

Photos have more detail than renders of a scene trained on them. `digest` takes some hundred `corners` of each training
photo, with the surface there from a render; `surface_points` finds each in the photo's neighbours by least-squares
matching of a small patch, and triangulates it with the photos' poses. A digest keeps the points and patches, not the
photos; `digest_file` stores it. `patch_pose` finds the patches in a photo whose pose is known to a few pixels, and
solves for a more exact one. `patch_matching` has what both share; its inner loops are `patch_kernels`.
"""
