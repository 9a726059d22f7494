"""Trajectories of a plant and their gradients."""
