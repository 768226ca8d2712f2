"""The motion of a bone that is given before and after an operation."""
