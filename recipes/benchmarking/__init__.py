"""What ``recipes/benchmark.py`` times, and how."""
