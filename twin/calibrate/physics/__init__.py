"""What recorded episodes say about contact: friction, masses, forces, and how poses are biased.

``cases`` reads episodes, ``simulate`` repeats them in the physics of the replays, ``likelihood``
compares, ``fit`` searches the best parameters and decides what is promoted, ``emulator`` says how
sure they are, and ``run`` does all of it for a command. ``docs/calibration.md`` explains it.
"""
