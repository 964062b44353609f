"""From corners to cameras: the model, a start, prior knowledge, least squares, and which terms the views support."""
