"""Commands that study methods: benches, benchmark, cohorts, virtual patients."""
