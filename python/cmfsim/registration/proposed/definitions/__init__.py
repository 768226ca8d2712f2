"""Landmarks by their definitions on skull and skin."""
