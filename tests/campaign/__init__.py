"""Random loops, sets, solvers and faults, and an oracle that shares no code with the library."""
