"""Reachable sets over time as a user holds them: tubes, partitions, files, sizes, tables."""
