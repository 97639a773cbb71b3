"""SE(3), trajectories, signals, meshes and camera models; NumPy only."""
