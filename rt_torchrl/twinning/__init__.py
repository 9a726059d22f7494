"""The six steps of Reinforcement Twinning."""
