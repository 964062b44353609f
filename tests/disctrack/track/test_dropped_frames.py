"""Frames in which the cameras contradict each other: how many times a delay is told."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack.findings import Kind
from disctrack.frames import rotation_from_vector
from disctrack.track.judge.dropped_frames import dropped_frames, frames_ahead
from disctrack.track.refine.assembly import fit_all
from tests.oracles.measured_disc import dots_of, measured


@pytest.mark.parametrize(("ahead", "said"), [((1, 1), ["right"]), ((1, -1), ["right", "left"])])
def test_one_delay_in_several_stretches_is_one_sentence(ahead, said):
    """Between stretches of one and the same delay the cameras only happen to agree."""
    trajectory = measured(n=60)
    markers = trajectory.markers_px.copy()
    refused = np.zeros(60, bool)
    for (first, end), k in zip(((8, 18), (30, 42)), ahead, strict=True):
        markers[first:end, 1] = trajectory.markers_px[first + k : end + k, 1]
        refused[first:end] = True
    seen = dots_of(replace(trajectory, markers_px=markers))
    fits = fit_all(seen, judged=False)
    told = dropped_frames(refused, replace(seen, R=fits.R_world_body, t=fits.t_world_body), range(60))
    assert [finding.kind for finding in told] == [Kind.DROPPED_FRAMES] * len(said)
    assert [finding.subject.camera for finding in told] == said
    assert {finding.numbers["images"].value for finding in told} == {1}
    assert "at frame 8" in told[0].text


@pytest.mark.parametrize(("lost", "turn_deg", "told"), [(20, 0.0, 20), (-37, 0.0, -37), (0, 0.0, 0), (0, 0.5, 0)])
def test_images_lost_by_one_camera_are_counted_by_what_each_sees_alone(lost, turn_deg, told, rng):
    """As sure of an attitude as one camera is; a camera that turned is no camera that lost images."""
    R = dots_of(measured(n=97)).R
    alone = np.einsum("cnij,njk->cnik", rotation_from_vector(np.radians(0.05) * rng.normal(size=(2, 97, 3))), R)
    turned = rotation_from_vector(np.radians(turn_deg) * np.array([0.6, 0.0, 0.8]))
    left, right = alone[0, max(-lost, 0) :][:60], turned @ alone[1, max(lost, 0) :][:60]
    assert frames_ahead(left, right) == told
