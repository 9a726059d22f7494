"""Real systems, simulated or not, and what stands between them and a policy."""
