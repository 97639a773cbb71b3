"""Gaussians fitted to images: begin, step, split, solve colours, correct cameras."""
