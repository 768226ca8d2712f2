"""The open benchmark: displacements of the skin, by any method, scored on virtual patients."""
