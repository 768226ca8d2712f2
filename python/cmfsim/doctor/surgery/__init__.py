"""Checks of cuts, plans and moved bones."""
