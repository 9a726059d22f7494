"""Classical controllers, and optimal commands over a receding horizon."""
