"""Classical controllers that policies are compared with."""
