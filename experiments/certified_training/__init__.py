"""Training until proved: five loops, five ways, equal time.

`python -m experiments.certified_training` trains and decides; interrupted, it continues.
`python -m experiments.certified_training.grown` trains a pendulum for the size of what is proved.
"""
