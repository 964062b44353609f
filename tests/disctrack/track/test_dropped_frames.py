"""Frames in which the cameras contradict each other: how many times a delay is told."""

from types import SimpleNamespace

import numpy as np
import pytest

from disctrack.track.judge import dropped_frames as slips


@pytest.mark.parametrize(
    ("delays", "sentences", "where"),
    [((2.9, 3.0, 2.8), 1, "before frame 0"), ((2.9, 2.9), 2, "at frame 5"), ((1.0, 2.0, 3.0), 3, "at frame 5")],
)
def test_one_delay_in_three_stretches_is_one_sentence(monkeypatch, delays, sentences, where):
    """Left-out images add up (1, 2, 3): the same number again and again was missing from the beginning."""
    edges = ((5, 12), (20, 28), (40, 50))[: len(delays)]
    stretch = np.zeros(60, int)
    for number, (first, end) in enumerate(edges, 1):
        stretch[first:end] = number

    def delay_of_right(*given):  # between the stretches the dots of both cameras agree by chance
        number = stretch[given[-1]].min()
        return (delays[number - 1], 0.99) if number else (0.0, 0.0)

    monkeypatch.setattr(slips, "delay_of_right", delay_of_right)
    fits, nothing = SimpleNamespace(residuals_px=np.zeros((60, 2, 4, 2))), np.zeros(0)
    told = slips.dropped_frames(stretch > 0, fits, nothing, nothing, None, nothing, range(60))
    assert len(told) == sentences
    assert where in told[0].text
