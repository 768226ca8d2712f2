"""From labels, levels or surfaces to tets, with a report of their quality.

`node_kinds` states what each node does; `lips` finds the seam at which the mesh is cut.
"""

from cmfsim.meshing.levels import TissueRegion as TissueRegion
from cmfsim.meshing.levels import anatomy_from_surfaces as anatomy_from_surfaces
from cmfsim.meshing.levels import near_skin as near_skin
from cmfsim.meshing.levels import signed_level as signed_level
from cmfsim.meshing.levels import tissue_level as tissue_level
from cmfsim.meshing.stuffing import MeshOptions as MeshOptions
from cmfsim.meshing.stuffing import TissueMesh as TissueMesh
from cmfsim.meshing.stuffing import mesh_findings as mesh_findings
from cmfsim.meshing.stuffing import mesh_from_labels as mesh_from_labels
from cmfsim.meshing.stuffing import mesh_from_level as mesh_from_level
from cmfsim.meshing.stuffing import mesh_report as mesh_report
from cmfsim.meshing.stuffing import part_mesh as part_mesh
from cmfsim.meshing.stuffing import report_of_part as report_of_part
from cmfsim.meshing.stuffing import separated_mesh as separated_mesh
