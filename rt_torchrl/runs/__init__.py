"""A training with everything around it: options, progress, checkpoints, results."""
