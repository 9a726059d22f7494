"""What reinforcement twinning is worth against its own halves, classical controllers and the best possible."""
