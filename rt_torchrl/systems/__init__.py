"""Real systems, simulated or not, and the layers between them and a policy."""
