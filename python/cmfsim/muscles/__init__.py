"""Muscles: templates carried to a patient, and the equivalent material that they give tets."""
