"""The names of the paper's four models."""

# Kim et al. 2010, section 3.2: homogeneous or with muscles, without or with sliding at teeth and
# mucosa.
MODELS = ("H", "M", "H+S", "M+S")
