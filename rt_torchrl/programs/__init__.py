"""Programs: torch functions as straight-line arithmetic, in machine code and in C."""
