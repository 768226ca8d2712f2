"""What the program's exit codes mean."""

__all__ = ["BAD_INPUT", "DONE", "FAILED"]

DONE, FAILED, BAD_INPUT = 0, 1, 2
