"""The mechanics of virtual patients: another discretisation and law than the solver's own."""
