"""Results: predictions, metrics, models, calibrations."""
