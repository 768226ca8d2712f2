"""Muscle templates: loaded, checked, made from an atlas, and morphed to patients."""
