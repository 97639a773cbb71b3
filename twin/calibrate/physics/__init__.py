"""Arm, hand and friction of imported recordings; ``docs/calibration.md`` explains it."""
