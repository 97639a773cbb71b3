"""What is what in a rebuilt scene: masks lifted into Gaussians, instances, parts, queries."""
