"""Many recordings as one system: shared quantities, the search over all of them, and inconsistent recordings."""
