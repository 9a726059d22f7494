"""Dynamics that a system may have beside those of its plant: each makes a new plant of any plant."""
