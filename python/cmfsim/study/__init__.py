"""Many cases, and many trials of one: cohorts by several models, and moved landmarks."""
