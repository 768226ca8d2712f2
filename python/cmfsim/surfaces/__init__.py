"""Triangle surfaces: how their parts are connected, what is wrong with them, and its repair."""
