"""Tell where a photo was taken inside a 3D Gaussian Splatting scene.

How data flows (each arrow is a module):

    photo bytes --images--> Query ---------------------------+
    scene folder --scene_formats--> GaussianScene            |
                                      |                      |
                                    render (Rasterizer)      |
                                      |                      v
    localize.py: makes the tools, drives one estimator, keeps clock, budget and cancel flag
                                      |
       estimators/view_index: retrieve -> match -> pnp -> align     (parts live in pose/)
                                      |
    IterationRecord, IterationRecord, ...   (the last one's pose is the answer)
                                      |
       pose/gate: one verification for every estimator -> PoseEstimate --api--> HTTP --> viewer

Read `localize.py` first, then `estimators/view_index.py`.
"""

__version__ = "0.1.0"
