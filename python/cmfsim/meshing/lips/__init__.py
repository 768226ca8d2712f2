"""The lips: the seam between them, and the part of a mesh's boundary that belongs to each."""
