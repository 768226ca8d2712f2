"""Pictures of a case, drawn off screen: anatomy, muscles, segments, node kinds, errors."""

from cmfsim.pictures.anatomy import (
    KIND_COLOURS,
    SEGMENT_COLOURS,
    SKIN_COLOUR,
    picture_anatomy,
    picture_node_kinds,
    picture_segments,
    segment_colours,
)
from cmfsim.pictures.canvas import Picture
from cmfsim.pictures.charts import MODEL_COLOURS, chart_errors
from cmfsim.pictures.distances import (
    DISTANCE_LIMIT,
    band_picture,
    contacts_picture,
    distance_colour,
    picture_band,
    picture_distance_grid,
    picture_distances,
)
from cmfsim.pictures.faces import picture_plan, picture_prediction, plan_picture, prediction_picture
from cmfsim.pictures.landmarks import picture_landmarks
from cmfsim.pictures.muscles import picture_muscles
from cmfsim.pictures.window import ViewPart, has_screen, view_parts

__all__ = [
    "DISTANCE_LIMIT",
    "KIND_COLOURS",
    "MODEL_COLOURS",
    "SEGMENT_COLOURS",
    "SKIN_COLOUR",
    "Picture",
    "ViewPart",
    "band_picture",
    "chart_errors",
    "contacts_picture",
    "distance_colour",
    "has_screen",
    "picture_anatomy",
    "picture_band",
    "picture_distance_grid",
    "picture_distances",
    "picture_landmarks",
    "picture_muscles",
    "picture_node_kinds",
    "picture_plan",
    "picture_prediction",
    "picture_segments",
    "plan_picture",
    "prediction_picture",
    "segment_colours",
    "view_parts",
]
