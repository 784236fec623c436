"""Camera poses from 2D-3D correspondences: PnP-RANSAC, an unknown focal length, decoupled solvers, and pose priors.

`pnp` wraps PoseLib's robust estimator, `unknown_focal` searches the focal length with it, `decoupled` solves for
rotation and translation in alternation from a nearby pose, `intrinsics_prior` holds what is known of an approximate
camera, `prior_region` tests poses against the region that a caller declared.
"""
