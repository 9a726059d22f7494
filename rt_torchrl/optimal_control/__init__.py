"""Optimal commands: of whole episodes whose disturbance is known, and over a receding horizon."""
