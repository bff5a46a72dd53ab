"""The one formula: rows over the basis, bounds, facts, relaxations, windows and the program."""
