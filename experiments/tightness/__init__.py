"""How tight certified reachable sets are, and what that costs, method by method.

python -m experiments.tightness --help
"""
