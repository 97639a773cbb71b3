"""Plain numbers in, judgement out: intervals, agreement, paired tests, correlation, ranking.

A statistic without a value raises ``UndefinedStatisticError`` with the reason.
"""
