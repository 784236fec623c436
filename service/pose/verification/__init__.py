"""Whether a pose is right: signals measured on a render there, and a fitted model that makes a probability of them.

`gate` decides by the signals of `appearance` and `signals` with `gate_model`, whose numbers are in `model.json`, and
by `precision`: is the pose as exact as was asked for? `rig_gate` combines the verdicts of several photos.
`captured_volume` finds poses whose view was not captured; `mirror_images` and `ambiguity` compare answers with one
another. `advice` says what would help a photo that is refused, `photo_quality` what is wrong with it as a picture.
"""
