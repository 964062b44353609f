"""What must not grow with the length of a recording, and where a long one is cut."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from disctrack import frames
from disctrack.disc import MA_2014
from disctrack.track.dots.template import dot_centres
from disctrack.track.follow.tracking import stretch_edges
from disctrack.track.pose import marker_pixels
from disctrack.track.refine.assembly import TrackingSettings, fit_all
from disctrack.track.refine.self_calibration import DotsInFrames
from disctrack.trajectory import FrameStatus
from tests.oracles.point_laboratory import DOT_PX, tables_of, tracked


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


def test_poses_are_the_same_to_the_last_bit_whoever_puts_them_together(rendered_pairs, rng, monkeypatch):
    monkeypatch.setattr("disctrack.track.refine.assembly.FITTED_AT_ONCE", 50)
    rig, n = rendered_pairs.rig, 230
    times = np.arange(n) / 1000.0
    angles = np.stack([0.1 + 9.0 * times, np.full(n, 0.35), 0.2 - 8.0 * times])
    R = frames.rotation_from_euler(*angles)
    t = rendered_pairs.q[0, :3] + 1e-3 * np.stack([np.cos(angles[0]), np.sin(angles[0]), 0.0 * times], axis=1)
    printed = MA_2014.marker_centres_body + 20e-6 * rng.standard_normal((6, 3)) * [1, 1, 0]
    pixels = marker_pixels(R, t, rig, printed)[0]
    pixels += DOT_PX * rng.standard_normal(pixels.shape)
    pixels[100, 1, 2] += 3.0  # a dot to be struck
    pixels[160:163, 0] += 0.1  # frames to be refused

    def by(workers, pixels=pixels):
        return tracked(pixels, R, t, times, rig, 1000.0, TrackingSettings(exposure=(1e-4, 1e-4)), workers)

    one, three = by(1), by(3)
    assert (one.trajectory.frame_status != FrameStatus.MEASURED).any()
    assert np.abs(one.as_built.marker_shift).max() > 5e-6
    for name, value in vars(one.trajectory).items():
        if isinstance(value, np.ndarray):
            assert value.tobytes() == getattr(three.trajectory, name).tobytes(), name
    assert (one.findings, one.shared_sigma) == (three.findings, three.shared_sigma)
    other = by(3, np.nextafter(pixels, np.inf))  # what one unit in the last place does is seen
    assert other.trajectory.q.tobytes() != one.trajectory.q.tobytes()
