"""From corners to cameras: model, initial guess, priors, least squares, and model selection."""
