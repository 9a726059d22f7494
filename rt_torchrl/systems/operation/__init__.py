"""Operation of a real system that acts on while the algorithm learns; docs/connect_your_machine.md explains it."""
