"""Identification of a twin from sensor logs, without control of the real system."""
