"""Design a study before its first trial: its size, its order, its locked protocol."""
