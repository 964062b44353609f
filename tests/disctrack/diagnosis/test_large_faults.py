"""Faults of the measurement that no search from null finds: degrees, millimetres, frames, factors."""

import numpy as np
import pytest

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.large_faults import poses_with
from disctrack.faults.keys import CameraFault, Faults
from disctrack.trajectory import Trajectory
from tests.disctrack.diagnosis.test_imperfect import recording
from tests.oracles.measured_disc import assert_sized, measured

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
