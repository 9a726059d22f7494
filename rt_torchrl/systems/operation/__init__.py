"""Operation of a real system that acts on while the algorithm learns; docs/asynchronous.md explains it."""
