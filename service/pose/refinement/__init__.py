"""Photometric refinement of a pose on a rendered RGB-D frame, and the uncertainty of the result.

`photometric` refines, coarse to fine, with `gauss_newton` on each `pyramid_level`; `uncertainty` linearizes at the
answer and estimates covariance (by the jackknife of `covariance`) and the last Gauss-Newton step; `lens_test` finds out
whether the pixels contradict exact intrinsics; `kernels` are the compiled inner loops, `refinement_config` all tuning
constants.
"""
