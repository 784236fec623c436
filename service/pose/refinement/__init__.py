"""Photometric refinement of a pose on a rendered RGB-D frame, and its covariance."""
