"""Descents of the assimilation (step 4) and the planning (step 5)."""
