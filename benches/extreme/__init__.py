"""The stiff and extreme suite that `benches/stability.py` runs, a module per subject."""
