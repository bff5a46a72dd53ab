"""What the library says of some hundred drawn cases, kept bit for bit, and compared."""
