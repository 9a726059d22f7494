"""Flapping-wing micro air vehicle (paper, section 5.2)."""
