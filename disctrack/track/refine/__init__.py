"""Refinement over the whole sequence of the parameters that all frames share."""
