"""What real episodes say about the twin's predictions."""
