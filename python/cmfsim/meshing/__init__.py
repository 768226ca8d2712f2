"""From labels, levels or surfaces to tets, with a report of their quality.

`node_kinds` states what each node does; `lips` finds the seam at which the mesh is cut.
"""

from cmfsim.meshing.levels import anatomy_from_surfaces, signed_level
from cmfsim.meshing.stuffing import (
    MeshOptions,
    TissueMesh,
    mesh_findings,
    mesh_from_labels,
    mesh_from_level,
    mesh_report,
    part_mesh,
    report_of_part,
    separated_mesh,
)
from cmfsim.meshing.tissue import TissueRegion, near_skin, tissue_level

__all__ = [
    "MeshOptions",
    "TissueMesh",
    "TissueRegion",
    "anatomy_from_surfaces",
    "mesh_findings",
    "mesh_from_labels",
    "mesh_from_level",
    "mesh_report",
    "near_skin",
    "part_mesh",
    "report_of_part",
    "separated_mesh",
    "signed_level",
    "tissue_level",
]
