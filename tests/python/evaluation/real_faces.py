"""Faces of real heads with their landmarks, and surfaces with other vertices."""

import cmfsim
import real_heads


def face(head="atlas_head", name="skin_open"):
    return real_heads.read_ply(head, name), dict(real_heads.landmarks(head, "skin"))


def moved(surface, vertices):
    return cmfsim.SurfaceData(vertices, surface.triangles)
