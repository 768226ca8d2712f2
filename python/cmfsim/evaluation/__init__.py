"""Predictions against the post-operative skin: partners, distances, regions, tests (paper 3.2)."""
