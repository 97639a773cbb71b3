"""Review pages over what the evaluator computed; no arithmetic here."""
