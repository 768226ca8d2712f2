"""The kind of each node: fixed, joined to a moved bone, sliding on teeth and mucosa, or free.

Kim et al. (2010), section 2.5 and Figure 4. Only nodes on the boundary of the mesh get a kind,
and those of the nasal septum.
"""

from cmfsim.meshing.node_kinds.arches import DentalArches, dental_arches
from cmfsim.meshing.node_kinds.classification import ClassifiedNodes, classify_nodes, segment_data
from cmfsim.meshing.node_kinds.options import KindOptions, SlidingBox, SlidingSphere, kind_options
from cmfsim.meshing.node_kinds.septum import lifted_tissue, septum

__all__ = [
    "ClassifiedNodes",
    "DentalArches",
    "KindOptions",
    "SlidingBox",
    "SlidingSphere",
    "classify_nodes",
    "dental_arches",
    "kind_options",
    "lifted_tissue",
    "segment_data",
    "septum",
]
