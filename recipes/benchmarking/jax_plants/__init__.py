"""The three plants of the paper in JAX, for comparison only: the same equations as in ``envs/``, in double precision.

Arrays hold the components first and the realisations last, so that the compiler vectorises over realisations.
"""
