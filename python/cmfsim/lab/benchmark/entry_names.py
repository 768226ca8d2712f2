"""The names of the package's own entries, which the command line lists before it loads any."""

from cmfsim.values.prediction import MODELS

NO_CHANGE, RATIOS, LEARNED, HYPERELASTIC = "no-change", "ratios", "pls", "hyperelastic"
ENTRIES = (NO_CHANGE, RATIOS, LEARNED, *MODELS)
# Entries that are made only on request: they take longer.
ON_REQUEST = (HYPERELASTIC,)
