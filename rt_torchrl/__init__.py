"""Reinforcement Twinning: a digital twin and two controllers, trained while the real system runs."""
