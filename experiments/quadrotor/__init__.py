"""The quadrotor: a learned controller, certified by ellipsoids.

python -m experiments.quadrotor --help
"""
