"""Surfaces and tet meshes of any format, one format a file."""
