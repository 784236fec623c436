"""What was estimated of a lens from earlier photos, as the prior of its next photo.

    photo's header -> key: whose camera, in which setting -> store -> estimate -> prior of the photo's intrinsics
    sure answer -> measurement without what the prior said -> estimate updated, or widened where they contradict

`lens_key` says which photos have one lens, `lens_estimate` how an estimate is updated, `lens_store` where estimates
are; `lens_memory` puts these together.
"""
