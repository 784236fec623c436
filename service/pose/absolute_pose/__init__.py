"""Camera poses from 2D-3D correspondences."""
