"""The parts of localization methods, a folder for each step.

From bottom to top: `features`, `absolute_pose`, `matching`, `refinement`, and then, side by side, `retrieval`,
`descent`, `verification` and `training_photos`. Each imports only from those below; `tests/test_architecture.py` checks
it.
"""
