"""Gaussian splats: initialise, rasterise, fit, localise, store."""
