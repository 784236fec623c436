"""Whether a pose is right: signals measured on a render there, and a fitted model that makes a probability of them.

`gate` decides by the signals of `appearance` and `signals` with `gate_model`, whose numbers are in `model.json`;
`mirror_images` and `ambiguity` compare answers with one another.
"""
