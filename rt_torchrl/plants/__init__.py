"""The contract of a plant, with closures and policies that any plant can use."""
