"""Landmarks of a case: found where none are placed, and checked against the bones."""
