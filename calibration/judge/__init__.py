"""Assessment of a fit: which views are pairs, tolerances of the board, accuracy of the rig."""
