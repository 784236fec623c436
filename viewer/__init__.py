"""The viewer: 3D Gaussian Splatting scenes in a browser, with the jobs of a running service."""
