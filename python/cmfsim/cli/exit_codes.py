"""The exit codes of the program."""

# The last is what shells report of a program that a closed pipe ended: 128 and the signal's number.
DONE, FAILED, BAD_INPUT, CLOSED = 0, 1, 2, 141
