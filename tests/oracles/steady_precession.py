"""Closed form of regular precession: constant nutation, the centre on a circle at constant height."""

import numpy as np


def centre(r, h, theta, p, q, psi0, x0, y0, t):
    """(n, 3) centre of the disc at psidot = p, omega3 = q; psi(0) = psi0, centre (x0, y0) at t = 0.

    The velocity of the centre along n0 is h p sin(theta) - r q, and n0 turns with p (Ma et al. 2014, (2.12), with the
    signs of R_O and of the cosine term corrected and h cos(theta) added to the height).
    """
    t = np.asarray(t)
    radius = (h * p * np.sin(theta) - r * q) / p
    x = x0 + radius * (np.sin(p * t + psi0) - np.sin(psi0))
    y = y0 - radius * (np.cos(p * t + psi0) - np.cos(psi0))
    return np.column_stack([x, y, np.full(t.shape, r * np.sin(theta) + h * np.cos(theta))])


def circle_middle(r, h, theta, p, q, psi0, x0, y0):
    """(2,) middle of the circles of centre and contact."""
    radius = (h * p * np.sin(theta) - r * q) / p
    return np.array([x0 - radius * np.sin(psi0), y0 + radius * np.cos(psi0)])


def contact_circle_radius(r, h, theta, p, q):
    """Radius of the circle that the contact runs on: the arc rolled off per turn, r |phidot| / p."""
    return abs(r * (q - p * np.cos(theta)) / p)
