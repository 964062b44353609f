"""From an image to a board's corners: the targets, how they are found, and where exactly each corner lies."""
