"""Rendered pairs with known truth, made once per run: rendering costs 0.2 s a pair."""

from dataclasses import dataclass

import numpy as np
import pytest

from calibration import StereoRig
from disctrack import Disc, frames
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from tests.rendering import render_disc


@dataclass(frozen=True)
class RenderedPairs:
    """Images of the disc in various attitudes, seen by the true rig."""

    images: np.ndarray  # (n, 2, H, W) uint8, with the sensor's noise
    q: np.ndarray  # (n, 6) truth
    R: np.ndarray  # (n, 3, 3)
    rig: StereoRig
    disc: Disc
    scene: Scene

    @property
    def true_pixels(self) -> np.ndarray:
        """(n, 2, m, 2) images of the dots' centres."""
        arm = self.disc.marker_centres_body @ np.swapaxes(self.R, 1, 2)
        return self.rig.project(arm + self.q[:, None, :3])


def disc_on_table(theta: np.ndarray, rng: np.random.Generator, disc: Disc) -> np.ndarray:
    """Poses (n, 6) that touch the table, anywhere in the middle of the field and turned anyhow."""
    n = len(theta)
    height = disc.radius * np.sin(theta) + disc.half_thickness * np.cos(theta)
    psi, phi = rng.uniform(-np.pi, np.pi, (2, n))
    return np.column_stack([rng.uniform(0.022, 0.042, n), rng.uniform(0.012, 0.028, n), height, psi, theta, phi])


@pytest.fixture(scope="session")
def rendered_pairs() -> RenderedPairs:
    """Twenty-four attitudes from almost flat to 45 deg, noise as in the reference recordings."""
    rng = np.random.default_rng(7)
    scene = Scene()
    rig, disc = rig_of(scene), scene.declared_disc
    q = disc_on_table(np.radians(np.r_[0.5, 0.5, 1.0, 2.0, np.linspace(3, 45, 20)]), rng, disc)
    R = frames.rotation_from_euler(*q[:, 3:].T)
    return RenderedPairs(render_disc(q, rig, disc, scene, rng), q, R, rig, disc, scene)
