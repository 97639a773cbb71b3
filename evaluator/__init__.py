"""How far twin and reality disagree, and how sure we are."""
