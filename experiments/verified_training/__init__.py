"""Controllers that are trained to be verifiable, against the same ones trained plainly.

python -m experiments.verified_training --help
"""
