"""Fits of a twin to records: by step 4, from sensor logs, with standard errors."""
