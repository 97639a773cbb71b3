"""What a replay happens in: the task, its objects, the rebuilt scene, the calibration."""
