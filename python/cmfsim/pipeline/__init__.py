"""A case through every stage: here alone the stages are connected, and their outputs written."""
