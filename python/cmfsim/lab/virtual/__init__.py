"""Virtual patients: synthetic heads, an operation, and the true face after it (*in silico*).

The true face is computed independently of the models that are tested on it: hyperelastic tissue, a
finer mesh, individual muscles and contact that only pushes, solved with scikit-fem and PyAMG.
`demo` writes the case that the package contains, and any head with its CT.
"""
