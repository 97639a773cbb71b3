"""What is to be achieved: task files, plans, verdicts and hard predicates; NumPy only."""
