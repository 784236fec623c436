"""Find where a photo was taken inside a 3D Gaussian Splatting scene.

How data flows, with the modules that take each step:

    photo bytes  --photos-->         Query --------------+
    scene folder --scene_formats-->  GaussianScene       |
                                       |                 |
                                     render, matchers    |
                                       v                 v
    localize         makes the tools, drives an estimator; keeps clock, budget and cancel flag
    estimators/      view_index: retrieval -> matching -> absolute pose -> refinement  (the steps: pose/)
                       |
                       v  IterationRecord, IterationRecord, ..., Answer
    pose/verification  the gate, the same for every estimator
                       |
                       v  PoseEstimate
    jobs, web        --> JSON over HTTP --> viewer

CONTRIBUTING.md has the order in which to read the code, under "Day one", and the map of all modules.
"""

__version__ = "0.2.0"
