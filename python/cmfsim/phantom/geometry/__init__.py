"""Curves and shapes that the synthetic head is made of."""
