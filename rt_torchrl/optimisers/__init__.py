"""Descents that steps 4 and 5 share."""
