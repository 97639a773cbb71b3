"""From an instruction to goals: a grammar without weights, and task files derived from it."""
