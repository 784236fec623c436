"""Whether a pose is right: calibrated gate, appearance, ambiguity, mirror images."""
