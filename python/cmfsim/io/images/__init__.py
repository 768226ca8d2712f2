"""Images of any format, one format a file, and the masks of segmentations."""

from cmfsim.io.images.image_files import read_image_file as read_image_file
