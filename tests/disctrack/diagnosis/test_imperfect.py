"""Lenses, print, board, light and clocks that are not ideal, by a little as in any laboratory, or by degrees."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.errors import LeftOver
from disctrack.diagnosis.large_faults import poses_with
from disctrack.diagnosis.stretch import at_rest
from disctrack.diagnosis.systematic import find_systematic, noise_over_stated, with_noise_of_frames
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.noise import inflation
from disctrack.discrepancy.system import Quantity, System
from disctrack.faults.keys import CameraFault, Faults
from disctrack.trajectory import Trajectory
from disctrack.validate.points import ORDINARY, Laboratory
from tests.oracles.measured_disc import assert_sized, measured, system_of


def recording(effects=None, *, laboratory=ORDINARY, faults=None, seed=1, n=300):
    """As a tracking states it whose covariances cover all that the dots show."""
    trajectory = measured(
        effects, faults=faults, laboratory=laboratory, seed=seed, n=n, declared_rate=500.0, theta_deg=9.0
    )
    inflated = max(1.0, float(np.median(trajectory.reduced_chi_square)))
    return replace(
        trajectory,
        markers_covariance_px2=inflated * trajectory.markers_covariance_px2,
        pose_covariance=inflated * trajectory.pose_covariance,
        reduced_chi_square=trajectory.reduced_chi_square / inflated,
    ), inflated


def systematic_of(trajectory):
    trajectory = with_noise_of_frames(trajectory)
    return find_systematic(system_of(trajectory))


def test_the_noise_is_what_changes_from_frame_to_frame():
    trajectory, inflated = recording()
    assert inflated > 5
    # 300 frames of 18 numbers: 2 %, and 4 % for third differences that share their frames
    assert noise_over_stated(trajectory) * inflated == pytest.approx(1.0, rel=0.08)
    ideal = measured(seed=2, n=200)
    assert with_noise_of_frames(ideal) is ideal


def test_a_camera_that_turned_does_not_make_the_motion_look_like_rest():
    """0.07 deg, 2.5 px: covariances that cover it are larger than what the disc moves in a frame."""
    turned = Faults(right=CameraFault(rotation_deg=(0.04, 0.05, 0.02)))
    trajectory, inflated = recording(laboratory=Laboratory(), faults=turned, n=120)
    assert inflated > 1e4
    measured_rows = np.flatnonzero(trajectory.measured)
    assert at_rest(trajectory, measured_rows).all()
    assert not at_rest(with_noise_of_frames(trajectory), measured_rows).any()


@pytest.mark.statistical
def test_fields_are_sized_from_the_dots_alone_and_faults_are_no_fields():
    found = systematic_of(recording()[0])
    assert found.left == pytest.approx(1.0, abs=0.1)  # 200 frames of 18 numbers: 2 %, and what bumps miss
    assert 0.008 < found.lens_px < 0.05  # 0.02 px over the whole image; the dots see a part of it
    assert found.beside == ()
    alone = systematic_of(recording(laboratory=Laboratory(), faults=Faults(right_delay_s=2e-4))[0])
    assert (alone.present, alone.beside) == (False, ("time_offset",))
    both = systematic_of(recording(faults=Faults(right_delay_s=2e-4))[0])
    assert both.lens_px > 0.008
    assert both.beside == ("time_offset",)
    assert not systematic_of(measured(seed=3, n=200)).present


@pytest.mark.statistical
def test_an_imperfect_laboratory_claims_nothing_about_the_motion():
    trajectory, _ = recording(seed=5)
    result = diagnose(trajectory)
    assert result.diagnosis.verdict != "unexplained"
    assert all(f.candidate.kind == "measurement" for f in result.diagnosis.found)
    assert result.sentence.startswith("Nothing")
    assert "systematic errors of 0.0" in result.sentence


class Line(System):
    """Rows of 24 numbers that are a multiple of a smooth course, and noise."""

    candidates, base = (), (Quantity("a", "1", 0.1),)

    def __init__(self, noise):
        n, w = noise.shape
        self.time, self.noise, self.weights = np.arange(n, dtype=float), noise, np.full(n, float(w))
        self.course = 0.01 * np.sin(0.02 * np.arange(n))[:, None] * np.cos(np.arange(w))

    def linearise(self, values, names):
        return self.noise - values["a"] * self.course, self.course[..., None][..., : len(names)]


def test_sigmas_know_that_neighbouring_rows_err_alike(rng):
    """Images of a dot two pixels apart share pixels of uneven gain: a correlation that one series hides."""

    def pulls(share):
        found = []
        for _ in range(200):
            white = rng.standard_normal((251, 24))
            line = Line((white[1:] + share * white[:-1]) / np.sqrt(1 + share**2))
            fitted = fit(line, line.base, {})
            factor = inflation(line, fitted)[0]
            found.append((fitted.values["a"] / fitted.sigma("a"), fitted.values["a"] / fitted.sigma("a") / factor))
        return np.std(found, axis=0)

    white, stated = pulls(0.21)  # correlation 0.2: a smooth sum has 1 + 2 * 0.2 of the variance
    # of 200 pulls the scatter is known to 5 %
    assert_allclose([white, stated], [np.sqrt(1.4), 1.0], rtol=0.18)
    assert white > 1.1
    assert_allclose(pulls(0.0), 1.0, rtol=0.18)


@pytest.mark.parametrize(
    ("left", "of_the_motion", "of_the_measurement", "doubtful"),
    [
        (LeftOver(1.10, 1.00, 1e-40, 0.5, 36), True, False, True),
        (LeftOver(1.10, 1.10, 1e-40, 1e-40, 36), False, True, False),
        (LeftOver(1.30, 1.20, 1e-9, 1e-9, 36), False, True, False),
        (LeftOver(9.00, 1.20, 1e-9, 1e-9, 36), True, False, True),
        (LeftOver(1.00, 1.00, 0.4, 0.6, 36), False, False, False),
        (LeftOver(1.09, 0.99, 0.02, 1.0, 36), False, False, True),  # a groove that a tilt stands in for
        (LeftOver(1.00, 1.03, 0.3, 4e-10, 36), False, False, False),  # a misprint beside a shaken table
        (LeftOver(1.22, 1.27, 0.4, 3e-4, 36), False, True, False),  # lenses with fields: nothing of the motion
        (LeftOver(1.18, 1.18, 2e-3, 5e-3, 36), False, True, False),  # likewise, and seen in the poses
        (LeftOver(1.80, 1.18, 2e-3, 5e-3, 36), False, False, True),
    ],
)
def test_what_is_left_is_the_motions_only_where_the_poses_alone_hold_it(
    left, of_the_motion, of_the_measurement, doubtful
):
    assert (left.of_the_motion, left.of_the_measurement, left.doubtful) == (of_the_motion, of_the_measurement, doubtful)


TURN_DEG, SHIFT_MM = (0.6, -0.7, 0.4), (1.2, -1.4, 0.8)
TURNED = {f"right_turned.rotation_{a}": float(np.radians(v)) for a, v in zip("xyz", TURN_DEG, strict=True)}
SHIFTED = {f"right_shifted.translation_{a}": 1e-3 * v for a, v in zip("xyz", SHIFT_MM, strict=True)}


def noisy(trajectory: Trajectory, sigma_px: float = 0.006) -> float:
    """Median of what the poses leave of the dots, over the noise."""
    return float(np.sqrt(np.nanmedian(trajectory.markers_residual_px**2) / 0.4549) / sigma_px)


def test_poses_with_the_fault_agree_again():
    turned = measured(faults=Faults(right=CameraFault(rotation_deg=TURN_DEG)), seed=3, n=60)
    assert noisy(turned) > 300
    # 18 of 24 numbers are left: root of 3/4; 2880 of them tell the median to 3 %
    assert noisy(poses_with(turned, TURNED)) == pytest.approx(0.866, rel=0.1)
    late = measured(faults=Faults(right_delay_s=3e-3), seed=3, n=60)
    assert noisy(late) > 100
    assert noisy(poses_with(late, {"time_offset.delay": 3e-3})) == pytest.approx(0.866, rel=0.1)


@pytest.mark.statistical
def test_a_clock_that_runs_at_twice_the_declared_rate_is_found():
    result = diagnose(measured(faults=Faults(frame_rate_hz=2000.0), seed=1, n=200))
    (found,) = result.diagnosis.found
    assert found.candidate.name == "frame_rate"
    assert_sized(result.diagnosis.after, {"frame_rate.change": 1.0}, 4, 1e-3)
    assert any("precession" in note for note in result.notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "truth"),
    [
        (Faults(right=CameraFault(rotation_deg=TURN_DEG)), TURNED),
        (Faults(right=CameraFault(translation_mm=SHIFT_MM)), SHIFTED),
        (Faults(right_delay_s=6e-3), {"time_offset.delay": 6e-3}),
    ],
)
def test_large_faults_are_named_and_sized_in_an_imperfect_laboratory(faults, truth):
    """1 deg, 2 mm, three frames; the fields of the lenses reach 0.02 px rms, and sigmas contain them."""
    result = diagnose(recording(faults=faults, seed=1)[0])
    found = [f.candidate for f in result.diagnosis.found]
    assert all(c.kind == "measurement" for c in found)
    assert any(set(truth) <= set(c.names) for c in found)
    assert_sized(result.diagnosis.after, truth, 4)
