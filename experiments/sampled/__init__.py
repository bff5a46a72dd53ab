"""Loops whose plants are differential equations, decided at all times."""
