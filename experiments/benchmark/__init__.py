"""Seconds of Reach-SDP, and the bounds they buy.

python -m experiments.benchmark steps | growth | loops | rivals | decisions | limits | smooth
python -m experiments.benchmark.interior_point agreement | products
python -m pytest experiments/benchmark/parts.py
"""
