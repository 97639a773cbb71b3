"""URDF models, kinematics, inverse kinematics, hulls."""
