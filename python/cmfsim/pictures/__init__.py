"""Pictures of a case, drawn off screen: anatomy, segments, node kinds, errors on skin, boxes."""

from cmfsim.pictures.anatomy import (
    KIND_COLOURS,
    SEGMENT_COLOURS,
    picture_anatomy,
    picture_node_kinds,
    picture_segments,
)
from cmfsim.pictures.charts import MODEL_COLOURS, chart_errors
from cmfsim.pictures.distances import DISTANCE_LIMIT, distance_colour, picture_distances

__all__ = [
    "DISTANCE_LIMIT",
    "KIND_COLOURS",
    "MODEL_COLOURS",
    "SEGMENT_COLOURS",
    "chart_errors",
    "distance_colour",
    "picture_anatomy",
    "picture_distances",
    "picture_node_kinds",
    "picture_segments",
]
