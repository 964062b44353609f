"""Whether a fit can be believed: which pairs show the board in one place, the board's sizes, how good the rig is."""
