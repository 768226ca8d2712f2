"""The plan of a drafted case: by scenes and files, and as a person types it."""
