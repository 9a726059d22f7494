"""The plants that ship with the library, a folder each."""
