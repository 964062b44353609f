"""Many recordings, one answer: shared quantities, own ones eliminated, what does not fit the others named."""
