"""Which penalty to train with, in equal time: none, samples, or certificates of three prices.

`python -m experiments.penalties` trains and decides; interrupted, it continues.
"""
