"""The scenes of a running process: stored, loaded, shared, evicted."""
