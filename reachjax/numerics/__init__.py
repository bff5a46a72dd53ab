"""Checks, pytrees, rounding, and the seam to the host."""
