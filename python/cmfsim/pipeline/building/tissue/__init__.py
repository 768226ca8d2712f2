"""The tissue of a case: mesh, ends, clefts, node kinds, contacts, muscles."""
