"""Clouds of Gaussians: what they hold, how they move, alone or with a soft body."""
