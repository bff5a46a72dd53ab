"""The library beside what a user would pick instead, loop by loop."""
