"""What smooth loops take: products, noise, long horizons, many states, and continuous time.

Each row is a question with what is asked of its answer, measured in a process of its own.
"""
