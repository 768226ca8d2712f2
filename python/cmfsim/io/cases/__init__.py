"""Case files and what belongs to them: plans, cohorts, variants, templates, scenes."""
