"""From labels, levels or surfaces to tets, with a report of their quality.

`node_kinds` states what each node does; `lips` finds the seam at which the mesh is cut.
"""
