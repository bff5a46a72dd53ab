"""What the library says of some ninety drawn cases, kept bit for bit, and compared."""
