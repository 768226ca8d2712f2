"""Images of any format, one format a file, and the masks of segmentations."""
