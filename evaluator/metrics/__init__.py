"""Arrays in, errors out: trajectory, image, outcome."""
