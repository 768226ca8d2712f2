"""Checks of landmarks, and of where skin and bones lie."""
