"""Pictures of a case, drawn off screen: anatomy, muscles, segments, node kinds, errors."""

from cmfsim.pictures.anatomy import KIND_COLOURS as KIND_COLOURS
from cmfsim.pictures.anatomy import SKIN_COLOUR as SKIN_COLOUR
from cmfsim.pictures.anatomy import picture_anatomy as picture_anatomy
from cmfsim.pictures.anatomy import picture_muscles as picture_muscles
from cmfsim.pictures.anatomy import picture_node_kinds as picture_node_kinds
from cmfsim.pictures.canvas import Picture as Picture
from cmfsim.pictures.charts import MODEL_COLOURS as MODEL_COLOURS
from cmfsim.pictures.charts import chart_errors as chart_errors
from cmfsim.pictures.distances import DISTANCE_LIMIT as DISTANCE_LIMIT
from cmfsim.pictures.distances import band_picture as band_picture
from cmfsim.pictures.distances import contacts_picture as contacts_picture
from cmfsim.pictures.distances import distance_colour as distance_colour
from cmfsim.pictures.distances import picture_distance_grid as picture_distance_grid
from cmfsim.pictures.distances import picture_distances as picture_distances
from cmfsim.pictures.faces import picture_prediction as picture_prediction
from cmfsim.pictures.faces import plan_picture as plan_picture
from cmfsim.pictures.faces import prediction_picture as prediction_picture
from cmfsim.pictures.landmarks import picture_landmarks as picture_landmarks
from cmfsim.pictures.window import ViewPart as ViewPart
from cmfsim.pictures.window import has_screen as has_screen
from cmfsim.pictures.window import view_parts as view_parts
