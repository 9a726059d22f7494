"""The plants that ship with the library; each has a folder."""
