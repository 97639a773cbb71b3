"""Numbers in, judgement out: intervals, agreement, paired tests."""
