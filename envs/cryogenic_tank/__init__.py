"""Cryogenic storage tank with a thermodynamic vent (paper, section 5.3)."""
