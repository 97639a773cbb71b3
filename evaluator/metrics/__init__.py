"""Arrays in, errors out: images, trajectories, outcomes."""
