"""Which policy is better: errors and trials of the comparison, by a protocol fixed beforehand.

Seeds [0, case]; every study is drawn and read by code that is not the evaluator's: outcomes come
from NumPy, fixed designs from SciPy's exact distributions. Written down before the first result:

1. Equal candidates, advice followed: 12 cases, success 10, 30, 50, 90 %, starts shared with
   correlation 0.3, not shared, and shared in half of the trials; 1,000 studies of each
   (``POLICY_STUDIES``). A study begins without a plan at 10 trials of each candidate; each of at
   most 10 looks follows the advice of the look before. Success: a winner is named in at most 5 %
   of the studies of the worst case, within two standard errors of 1,000 studies (6.4 %), and in at
   most 5 % over all of them.
2. Rates 35 and 65 %, 65 and 95 %, starts shared (correlation 0) and not shared, planned by
   ``design`` with the trials of a fixed design of 80 % power: the smallest number from which on
   Boschloo's test (not shared) or McNemar's exact test (shared) has 80 % power. Counted out, not
   simulated. Success: the median number of trials is at most 0.75 of that design's, and at least
   80 % of the studies are decided by its number, in each of the four.
3. The size of a planned study, counted out over success rates of 2 to 98 %, 8 to 200 pairs.
   Success: at most 5 % each.
4. Intervals of the difference, at the look at which a study stops: 35 and 65 %, 65 and 95 %, 50
   and 50 %, starts shared and not. Success: least coverage at least 93 %.
"""
