"""Two tanks, one above the other: the Cascaded Tanks benchmark of nonlinear system identification."""
