"""What must not grow with the length of a recording, and where a long one is cut."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from disctrack import frames
from disctrack.track.dots.template import dot_centres
from disctrack.track.follow.tracking import stretch_edges
from disctrack.track.refine.assembly import fit_all
from disctrack.track.refine.self_calibration import DotsInFrames
from tests.oracles.point_laboratory import tables_of


@pytest.mark.parametrize(
    ("n", "stretches"), [(1, 1), (999, 1), (1000, 2), (3999, 2), (4000, 4), (16000, 8), (10**6, 32)]
)
def test_stretches_follow_from_the_length_alone_and_cover_it(rendered_pairs, n, stretches):
    edges = stretch_edges(range(70, 70 + n), rendered_pairs.disc)
    assert len(edges) == stretches + 1
    assert (edges[0], edges[-1]) == (70, 70 + n)
    assert np.ptp(np.diff(edges)) <= 1


def test_dots_that_leave_phi_open_are_followed_in_one_stretch(rendered_pairs):
    four = replace(rendered_pairs.disc, marker_centres_body=rendered_pairs.disc.marker_centres_body[[0, 1, 3, 4]])
    assert len(stretch_edges(range(5000), four)) == 2


def test_what_the_fit_of_all_poses_needs_beside_its_result_does_not_grow_with_their_number(rendered_pairs, monkeypatch):
    monkeypatch.setattr("disctrack.track.refine.assembly.FITTED_AT_ONCE", 512)
    rig, disc = rendered_pairs.rig, rendered_pairs.disc
    R, t = frames.rotation_from_euler(*rendered_pairs.q[:, 3:].T), rendered_pairs.q[:, :3]
    beside = []
    for n in (1536, 4608):
        k = np.arange(n) % len(R)
        tables = tables_of(rendered_pairs.true_pixels[k], R[k], t[k], 0.01)
        dots = dot_centres(tables.results, tables.status)
        tracemalloc.start()
        fits = fit_all(DotsInFrames(rig, disc, dots.pixels, dots.covariance_px2, tables.R, tables.t))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert fits.converged.all()
        beside.append(peak - sum(value.nbytes for value in vars(fits).values()))
    # three times the frames; before they were fitted in parts it was three times the memory
    assert beside[1] < 1.2 * beside[0]
