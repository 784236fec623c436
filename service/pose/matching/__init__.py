"""2D-3D correspondences between a photo and rendered views."""
