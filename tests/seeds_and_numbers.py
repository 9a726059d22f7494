"""Generators with a seed and tensors in double precision, which most tests need."""

import torch


def seeded(seed=0):
    """A new generator with the seed."""
    return torch.Generator().manual_seed(seed)


def double(*values):
    """The values as a tensor in double precision."""
    return torch.tensor(values, dtype=torch.float64)
