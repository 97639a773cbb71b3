"""Collision-free timed movements of the arm (paper section III-C, errata resolutions 8 to 10)."""
