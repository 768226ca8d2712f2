"""Files that commands on cases write: models, predictions, reports and pages."""
