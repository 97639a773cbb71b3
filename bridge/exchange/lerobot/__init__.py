"""LeRobotDataset v3.0 in and out, without the lerobot package."""
