"""The six steps of the paper, one file each."""
