"""Error against run time: what each choice of a prediction costs, and what it buys."""
