"""Gymnasium's pendulum: a real system that is not this library's own."""
