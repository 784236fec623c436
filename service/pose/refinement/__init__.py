"""Photometric refinement of a pose on a rendered RGB-D frame, and the uncertainty of the result.

`refine_stage` is the stage of a search: it alternates renders with `photometric`, which refines on one render, coarse
to fine, with `gauss_newton` on each `pyramid_level` of the `pyramid`; `rig_refinement` does so for several photos at
once. `uncertainty` linearizes at the answer and estimates covariance (by the jackknife of `covariance`) and the last
Gauss-Newton step; `lens_test` finds out whether the pixels contradict exact intrinsics, `rolling_shutter` whether the
camera turned. `kernels` are the compiled inner loops; `refinement_config` has the tuning constants, but for those of
the stage.
"""
