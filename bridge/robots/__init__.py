"""What a robot, its gripper and its tool are: records read from TOML files and URDF."""
