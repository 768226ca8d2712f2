"""The skin of a case: its part of the mesh, its check, its lips."""
