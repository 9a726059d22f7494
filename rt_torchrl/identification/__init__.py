"""Twins from logs of a plant that nobody controls."""
