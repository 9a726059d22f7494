"""The six steps of the paper, one chapter each."""
