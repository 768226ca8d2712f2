"""Time and memory of one run, measured in a process of its own."""
