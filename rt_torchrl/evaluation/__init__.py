"""Evaluation of twin and policies on episodes that no training has drawn."""
