"""What is proved or refuted of a loop: specifications, winning sets, invariance."""
