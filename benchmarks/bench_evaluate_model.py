"""Does the model of agreement cover? On the truths of ``agreement_truths.py``, fixed beforehand.

``MODEL_DRAWS`` (20) is the number of studies of each cell (truth, groups, trials, factor of the
twin's trials). Success: least coverage over truths of r and of the bias at least 93 %; mean width
of r at most 1.15 of the narrowest other method that covers 93 % on every truth: compared are
Fisher's interval of the measured r, the jackknife on Fisher's scale, and Fieller's interval of the
covariance without the noise of counting (jackknife).
"""
