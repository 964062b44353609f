"""What all frames share is refined over the whole sequence."""
