"""Do the intervals hold what they promise? Computed, stored, and asked before one is printed.

``exact`` counts outcomes out, ``simulate`` draws them where they are too many, ``stored`` reads the
map that benchmarks/bench_evaluate_coverage.py makes of both.
"""
