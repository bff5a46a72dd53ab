"""Flows: what follows the states of a differential equation, enclosed."""
