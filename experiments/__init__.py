"""Studies that a person can run: `python -m experiments.<name>`."""
