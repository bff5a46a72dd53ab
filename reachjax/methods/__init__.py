"""How reachable sets are bounded: the problem, its methods, and cells that any of them bounds."""
