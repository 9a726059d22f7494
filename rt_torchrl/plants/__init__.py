"""What a plant is, and the laws that may stand in it."""
