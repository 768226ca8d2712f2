"""The stiff and extreme suite that `benches/stability/stability.py` runs, a module per subject."""
