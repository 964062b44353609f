"""The disc is followed from pair to pair through the recording."""
