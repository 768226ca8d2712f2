"""The kind of each node: fixed, joined to a moved bone, sliding on teeth and mucosa, or free.

Kim et al. (2010), section 2.5 and Figure 4. Only nodes on the boundary of the mesh get a kind,
and those of the nasal septum.
"""
