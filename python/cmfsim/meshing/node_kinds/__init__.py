"""The kind of each node: fixed, joined to a moved bone, sliding on teeth and mucosa, or free.

Kim et al. (2010), section 2.5 and Figure 4. Only nodes on the boundary of the mesh get a kind,
and those of the nasal septum.
"""

from cmfsim.meshing.node_kinds.arches import DentalArches as DentalArches
from cmfsim.meshing.node_kinds.arches import dental_arches as dental_arches
from cmfsim.meshing.node_kinds.classification import ClassifiedNodes as ClassifiedNodes
from cmfsim.meshing.node_kinds.classification import classify_nodes as classify_nodes
from cmfsim.meshing.node_kinds.classification import segment_data as segment_data
from cmfsim.meshing.node_kinds.options import KindOptions as KindOptions
from cmfsim.meshing.node_kinds.options import SlidingBox as SlidingBox
from cmfsim.meshing.node_kinds.options import SlidingSphere as SlidingSphere
from cmfsim.meshing.node_kinds.options import kind_options as kind_options
from cmfsim.meshing.node_kinds.septum import lifted_tissue as lifted_tissue
from cmfsim.meshing.node_kinds.septum import septum as septum
