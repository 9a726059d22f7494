"""Descents that step 4, the assimilation, and step 5, the planning, share."""
