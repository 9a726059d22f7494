"""The NREL 5-MW wind turbine."""
