"""Hypotheses about what the real system has beside its twin."""
