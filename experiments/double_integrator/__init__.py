"""The double integrator: two learned controllers, certified.

python -m experiments.double_integrator --help
"""
