"""What a user asks for: reachable sets over time, partitions, specifications, sizes, pictures."""
