"""What recorded episodes say about contact: friction, masses, forces, and how poses are biased.

``data`` reads episodes into cases, ``drive`` lives one case through in the physics of the replays,
``likelihood`` compares, ``search`` looks for the best parameters, ``local`` says how sure they are,
``fit`` decides what is promoted, ``record`` keeps it. ``docs/calibration.md`` explains it.
"""
