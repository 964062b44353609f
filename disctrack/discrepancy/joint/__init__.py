"""Many recordings as one system: what they share, how the search goes over all of them, and who does not fit."""
