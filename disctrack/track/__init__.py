"""The tracking stage: image pairs become the trajectory, each pose with its covariance."""
