"""A lens beyond its polynomial: found from chessboards where it is, and not where it is not."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline

from calibration import refine_stereo, triangulate
from calibration.cameras.splines import LensField
from calibration.fit.lens_field import fit_lens_field
from tests.oracles.drawn_boards import make_scene

SIGMA = 0.004  # [px] of good corners


def field_of(pixels, camera):
    """0.02 px rms per axis, beyond any radial polynomial."""
    x, y = np.moveaxis(pixels / 512 * 2 * np.pi, -1, 0)
    waves = np.stack([np.sin(1.1 * x + 0.7 * y + camera), np.cos(0.8 * x - 1.2 * y + 2 * camera)], axis=-1)
    return 0.02 * np.sqrt(2) * waves


@pytest.fixture(scope="module")
def refined():
    """Refinements of sixteen views, through plain lenses and through such a field."""
    scene = make_scene(n_views=16)
    o = scene.observations(SIGMA, np.random.default_rng(3))
    moved = np.where((o.camera == 0)[:, None], field_of(o.pixels, 0), field_of(o.pixels, 1))
    bent = replace(o, pixels=o.pixels + moved)
    return scene, [refine_stereo(seen, scene.model, scene.board.points) for seen in (o, bent)]


def test_a_field_is_of_cubic_splines_whose_first_node_lies_one_spacing_before_the_image(rng):
    pixels, field = rng.uniform(0, 300, (20, 2)), LensField(rng.normal(size=(2, 2, 6, 6)), 100.0)
    b = BSpline.basis_element(np.arange(5.0), extrapolate=False)
    x, y = (np.nan_to_num(b(place[:, None] / 100.0 - np.arange(6) + 3)) for place in pixels.T)
    weight = y[:, :, None] * x[:, None]
    assert_allclose(field.splines(pixels).reshape(20, 6, 6), weight, atol=1e-12)
    displacement = np.einsum("nyx,ayx->na", weight, field.coefficients[1])
    assert_allclose(field.displacement(pixels, 1), displacement, atol=1e-12)


def test_field_is_found_and_the_geometry_is_better_for_it(refined):
    scene, (_, bent) = refined
    corrected = fit_lens_field(bent)
    # all that is left is the corners' own noise: 0.5 to 2 times SIGMA, unequal on the axes
    assert bent.chi_square > 3
    assert corrected.chi_square < 1.25

    def length_error(model, field):
        """Of the distances between neighbouring corners, triangulated from noiseless images [m]."""
        errors = []
        for v in range(16):
            seen = np.stack([p + field_of(p, c) for c, p in enumerate((scene.pixels(0)[v], scene.pixels(1)[v]))])
            points = triangulate(field.corrected(seen) if field else seen, model.rig)
            errors.append(np.linalg.norm(np.diff(points, axis=0), axis=1)[:8] - scene.board.square)
        return np.std(errors)

    plain = length_error(bent.model, None)
    assert length_error(corrected.model, corrected.lens_field) < 0.4 * plain


@pytest.mark.statistical
def test_what_varies_within_a_cell_is_found_too():
    """Waves of a third of the image: a grid of five cells leaves of them what is seen in chi-square."""
    scene = make_scene(n_views=16)
    o = scene.observations(SIGMA, np.random.default_rng(4))
    waves = np.sin(o.pixels @ [[0.035, 0.02], [0.015, -0.038]] + o.camera[:, None])
    bent = refine_stereo(replace(o, pixels=o.pixels + 0.03 * waves), scene.model, scene.board.points)
    assert fit_lens_field(bent).chi_square < 1.5


def test_plain_lenses_and_few_views_get_no_field(refined):
    scene, (plain, bent) = refined
    assert fit_lens_field(plain) is plain
    few = bent.observations[bent.observations.view < 6]
    assert fit_lens_field(refine_stereo(few, bent.model, scene.board.points)).lens_field is None
