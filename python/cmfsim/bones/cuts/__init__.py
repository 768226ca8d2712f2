"""Cuts through bone: procedures, their planes, and the pieces that they leave."""
