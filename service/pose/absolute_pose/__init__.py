"""Camera poses from 2D-3D correspondences: PnP-RANSAC, unknown intrinsics, decoupled solvers, and pose priors.

`pnp` is P3P (`p3p`) in a robust search (`ransac`); `unknown_lens` begins with it, refines focal length, radial
distortion and principal point with the pose, and tests exact intrinsics by matches; `lens_prior` is the prior on these,
`lens_kernels` the compiled inner loop; `fisheye` tells fisheyes and lenses of no model from pinholes, by the same
`normal_equations`. `rig_pose` is the same search for several cameras at once, compiled in `rig_kernels`. `decoupled`
solves for rotation and translation in alternation from a nearby pose. `prior_region` tests poses against the region
that a caller declared, `device_priors` against what a device measured.
"""
