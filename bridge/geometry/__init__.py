"""Frames, SE(3), trajectories and camera models; NumPy only."""
