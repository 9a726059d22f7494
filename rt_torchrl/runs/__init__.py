"""Runs of a training, with their options, progress, checkpoints and results."""
