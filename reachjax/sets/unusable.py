"""What is wrong with a set, told apart from every other error that a computation may raise."""


class UnusableSetError(ValueError):
    """A set is empty or unbounded, or a sequence of sets: nothing can be computed from it."""


class ThinSetError(RuntimeError):
    """A set is too thin, or its numbers are too uneven, for what was asked of it."""
