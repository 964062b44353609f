"""What must not grow with the length of a recording, and where a long one is cut."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from disctrack import frames
from disctrack.readers.blocks import iter_pair_blocks
from disctrack.track.as_printed import AsBuilt
from disctrack.track.assembly import _fit_all
from disctrack.track.following import empty_tables
from disctrack.track.tracking import MOST_STRETCHES, stretch_edges


@pytest.mark.parametrize(
    ("n", "stretches"), [(1, 1), (999, 1), (1000, 2), (3999, 2), (4000, 4), (16000, 8), (10**6, MOST_STRETCHES)]
)
def test_stretches_follow_from_the_length_alone_and_cover_it(rendered_pairs, n, stretches):
    edges = stretch_edges(range(70, 70 + n), rendered_pairs.disc)
    assert len(edges) == stretches + 1
    assert (edges[0], edges[-1]) == (70, 70 + n)
    lengths = np.diff(edges)
    assert lengths.max() - lengths.min() <= 1


def test_dots_that_leave_phi_open_are_followed_in_one_stretch(rendered_pairs):
    four = replace(rendered_pairs.disc, marker_centres_body=rendered_pairs.disc.marker_centres_body[[0, 1, 3, 4]])
    assert len(stretch_edges(range(5000), four)) == 2


class Counted:
    """A reader whose frame i is full of i."""

    timestamps, notes, random_access, bit_depth, image_size = None, (), True, 8, (4, 3)

    def __len__(self):
        return 100

    def describe(self, index):
        return f"frame {index}"

    def read(self, index, out=None):
        out[...] = index
        return out

    def content_sha256(self, start, stop):
        return ""


def test_blocks_begin_at_the_breaks_and_hold_every_frame_once():
    seen = []
    for block in iter_pair_blocks(Counted(), Counted(), 5, 93, block=16, threads=2, breaks=[0, 40, 41, 80, 99]):
        assert_array_equal(block.images[:, 0, 0, 0], block.frames)
        seen.append(block.frames.copy())
    assert {5, 40, 41, 80} <= {int(block[0]) for block in seen}
    assert_array_equal(np.concatenate(seen), np.arange(5, 93))
    # the same blocks for whoever begins at a break
    late = [b.frames.copy() for b in iter_pair_blocks(Counted(), Counted(), 41, 93, block=16, breaks=[40, 41, 80])]
    for a, b in zip(late, seen[-len(late) :], strict=True):
        assert_array_equal(a, b)


def test_what_the_fit_of_all_poses_needs_beside_its_result_does_not_grow_with_their_number(rendered_pairs, monkeypatch):
    monkeypatch.setattr("disctrack.track.assembly.FITTED_AT_ONCE", 512)
    rig, disc = rendered_pairs.rig, rendered_pairs.disc
    R, t = frames.rotation_from_euler(*rendered_pairs.q[:, 3:].T), rendered_pairs.q[:, :3]
    pixels = rendered_pairs.true_pixels
    m = disc.n_markers
    built = AsBuilt(rig, disc, np.zeros((m, 3)), np.zeros((m, 2)), np.zeros(30), 1.0, 1.0, 0)
    beside = []
    for n in (1536, 4608):
        k = np.arange(n) % len(R)
        covariance = np.broadcast_to(1e-4 * np.eye(2), (n, 2, m, 2, 2)).copy()
        status = np.zeros((n, 2, m), np.uint8)
        tables = replace(empty_tables(n, m), pixels=pixels[k], covariance_px2=covariance, status=status, R=R[k], t=t[k])
        tracemalloc.start()
        fits = _fit_all(tables, built, reject_outliers=True)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert fits.converged.all()
        beside.append(peak - sum(value.nbytes for value in vars(fits).values()))
    # three times the frames; before they were fitted in parts it was three times the memory
    assert beside[1] < 1.2 * beside[0]
