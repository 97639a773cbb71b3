"""Intel RealSense depth cameras: D435 (fixed views) and D405 (at the wrist)."""
