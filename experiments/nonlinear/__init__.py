"""Loops that are not affine or no ReLU chains: a pendulum, a car, TORA, an oscillator."""
