"""Positions of the dots in one image, and search for the disc in two images without a prior."""
