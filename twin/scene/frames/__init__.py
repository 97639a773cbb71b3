"""From an episode to posed frames: which to learn from, where their camera was, what they show."""
