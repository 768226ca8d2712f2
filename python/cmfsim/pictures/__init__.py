"""Pictures of a case, drawn off screen: anatomy, bone segments, node kinds, errors on the skin."""

from cmfsim.pictures.anatomy import (
    KIND_COLOURS,
    SEGMENT_COLOURS,
    picture_anatomy,
    picture_node_kinds,
    picture_segments,
)

__all__ = [
    "KIND_COLOURS",
    "SEGMENT_COLOURS",
    "picture_anatomy",
    "picture_node_kinds",
    "picture_segments",
]
