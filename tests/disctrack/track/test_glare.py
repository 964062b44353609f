"""Light that is added to the image: its gradient shifts templates, and the dots' contrasts tell by how much."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from disctrack import frames, rolling
from disctrack.track.dots.template import NoiseModel
from disctrack.track.dots.template_response import Edge
from disctrack.track.pose import marker_pixels
from disctrack.track.refine.glare import shift_by_glare
from tests.oracles.flat_dots import covered, locate_in_window

N, DARK, PAPER, NOISE = 24, 8000.0, 50000.0, NoiseModel(1e4, 8.0)


@pytest.fixture(scope="module")
def located(rendered_pairs):
    """Contrast and shift of the left camera's dots under light that falls off, and under that with glare."""
    rig, disc = rendered_pairs.rig, rendered_pairs.disc
    start = rolling.steady_precession(np.radians(15), disc, 9.81)
    q = rolling.simulate(rolling.Model(disc, 9.81), start, times=np.arange(N) / 200).q
    q[:, :2] += np.array([0.032, 0.02]) - q[:, :2].mean(axis=0)
    R, t = frames.rotation_from_euler(*q[:, 3:].T), q[:, :3]
    pixels, J = marker_pixels(R, t, rig, disc.marker_centres_body)
    affine = 0.5 * disc.marker_diameter * (J[:, 0, :, :, :3] @ R[:, None, :, :2])
    middle = pixels[:, 0].mean(axis=(0, 1))
    y, x = np.mgrid[:64, :64]
    found = {}
    for kind, glare in (("falls off", 0.0), ("glare", 3000.0)):
        contrast, shift = np.full((N, 2, disc.n_markers), np.nan, np.float32), np.zeros((N, disc.n_markers, 2))
        for frame in range(N):
            for dot in range(disc.n_markers):
                centre, A = pixels[frame, 0, dot], affine[frame, dot]
                window = np.round(centre) - 31
                plain = PAPER - (PAPER - DARK) * covered([centre - window], [A], 0.6)
                place = np.stack([x, y], axis=-1) + window - middle
                added = glare * np.exp(-0.5 * np.sum((place - [30, -20]) ** 2, axis=-1) / 70.0**2)
                lit = plain * (1 - 4e-4 * place @ [1.0, 0.5]) + added
                of_plain, of_lit = (locate_in_window(image, centre, A, noise=NOISE) for image in (plain, lit))
                shift[frame, dot] = (of_lit.pixels - of_plain.pixels)[0]
                contrast[frame, 0, dot] = of_lit.contrast[0]
        found[kind] = contrast, shift
    edge = Edge(0.65, PAPER, 1 - DARK / PAPER, NOISE)

    def told(contrast, frames=slice(None)):
        return shift_by_glare(R[frames], t[frames], contrast[frames], rig, disc, (edge, edge))

    return found, told


def test_glare_shifts_dots_and_their_contrasts_tell_by_how_much(located):
    found, told = located
    contrast, shift = found["glare"]
    given = told(contrast)
    assert np.sqrt(np.mean(shift**2)) > 0.002  # px
    # single dots scatter with the place of their edge among the pixels
    assert np.sqrt(np.mean((given[:, 0] - shift) ** 2)) < 0.2 * np.sqrt(np.mean(shift**2))
    assert not given[:, 1].any()  # the camera in which no dot was seen


def test_light_that_falls_off_shifts_nothing(located):
    found, told = located
    contrast, shift = found["falls off"]
    assert np.sqrt(np.mean(shift**2)) < 1e-4  # px; single ones 5e-4, where another pixel counts to the edge
    assert np.abs(told(contrast)).max() < 2e-4


def test_flicker_and_dots_of_different_ink_are_no_gradient(located, rng):
    found, told = located
    contrast = found["glare"][0]
    uneven = contrast + 0.03 * rng.normal(size=(N, 1, 1)) + 0.03 * rng.normal(size=contrast.shape[2])
    assert np.abs(told(uneven.astype(np.float32)) - told(contrast)).max() < 2e-4  # px


def test_what_a_resting_disc_repeats_is_no_evidence(located, rng):
    """Copies of the first and last frame, each with one error of the contrasts, that outnumber the motion."""
    found, told = located
    contrast = found["falls off"][0] + 0.003 * rng.normal(size=(N, 1, 6)).astype(np.float32)
    rests = np.r_[np.zeros(100, int), np.arange(N), np.full(100, N - 1)]
    assert_array_equal(told(contrast, rests), told(contrast)[rests])
    assert not told(contrast, np.zeros(200, int)).any()
    assert told(np.full_like(contrast, np.nan)).shape == (N, 2, 6, 2)


def test_a_disc_at_rest_or_a_single_dot_tells_nothing(located):
    _, told = located
    contrast = np.full((N, 2, 6), np.nan, np.float32)
    contrast[:, :, 2] = 0.8
    assert not told(contrast).any()
