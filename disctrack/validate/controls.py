"""Planted faults: what must not matter must not, and what must be noticed must be, by the measurement or by the truth.

A validation that cannot fail says nothing. Each fault is planted in the images or in what the measurement is told; the
same poses without any fault are the baseline, and must raise no alarm.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import N_RIG, WORLD_TURN, StereoRig
from calibration.kit.arrays import Array
from disctrack.disc import Disc
from disctrack.errors import TrackingError
from disctrack.synthetic import render_disc, rig_after_faults
from disctrack.synthetic.description import CameraFault, Faults, Scene
from disctrack.track.tracking import Tracking
from disctrack.validate.comparison import PoseErrors, compare
from disctrack.validate.stress import CLAIM_POSITION, CLAIM_ROTATION, LOST_ALLOWED, stress_poses
from disctrack.validate.trial import every, locate

N_POSES = 24  # the measurement judges its own scatter from 20 pairs on
DIAMETER_FAULT = 1.08
MISPRINT = 0.1e-3  # [m] of one dot
TURN = 1e-3  # [rad] of a camera, or of the pair
ALARM_SHIFT = 20e-6  # [m] a dot's refined place from its declared one
ALARM_GAP = 20e-6  # [m] rms between the rim and the table: the disc stands on it in every pose
SAME = 1.3  # errors beyond this multiple of the baseline's: it mattered (chance alone: 1 +- 0.1)


@dataclass(frozen=True)
class Control:
    """What a planted fault did."""

    fault: str
    must_be_noticed: bool
    alarms: tuple[str, ...]  # raised by the measurement itself, without the truth
    position: float  # [m] rms per axis against the truth, NaN without any pose
    rotation: float  # [rad]
    claim_fails: bool
    mattered: bool  # errors larger than the baseline's by more than chance allows

    @property
    def as_expected(self) -> bool:
        """What must be noticed was, by an alarm or by errors beyond the claim; what must not matter did not."""
        if self.must_be_noticed:
            return bool(self.alarms) or self.claim_fails
        return not self.alarms and not self.mattered


@dataclass(frozen=True)
class _Case:
    fault: str
    must_be_noticed: bool
    filmed_by: StereoRig
    told_rig: StereoRig
    printed: Disc
    told_disc: Disc
    swapped: bool = False


def planted_faults(scene: Scene, true: StereoRig, own: StereoRig) -> tuple[Control, ...]:
    """Controls, the baseline first. true, own: the cameras as they are, and as calibrated."""
    disc, rng = scene.declared_disc, np.random.default_rng([scene.seed, 11])
    q = stress_poses(N_POSES, true, scene, rng)
    turned = replace(scene, faults=Faults(left=CameraFault(rotation_deg=(0.0, float(np.degrees(TURN)), 0.0))))
    tilt = np.zeros(N_RIG)
    tilt[WORLD_TURN.start] = TURN
    shifted = disc.marker_centres_body + MISPRINT * (np.arange(disc.n_markers) == 2)[:, None] * np.array([0.6, 0.8, 0])
    cases = [
        _Case("none", False, true, own, disc, disc),
        _Case(
            f"dots declared {100 * (DIAMETER_FAULT - 1):.0f} % too large", False, true, own, disc,
            replace(disc, marker_diameter=DIAMETER_FAULT * disc.marker_diameter),
        ),
        _Case("one dot printed 0.1 mm off", True, true, own, replace(disc, marker_centres_body=shifted), disc),
        _Case("left and right exchanged", True, true, own, disc, disc, swapped=True),
        _Case("left camera turned by 1 mrad since", True, rig_after_faults(true, turned), own, disc, disc),
        _Case("both cameras turned by 1 mrad since", True, true.perturbed(tilt), own, disc, disc),
    ]  # fmt: skip
    controls: list[Control] = []
    for case in cases:
        # exchanged cameras need no statistics, and a search that finds nothing takes long
        poses = q[::4] if case.swapped else q
        images = render_disc(poses, case.filmed_by, case.printed, scene, np.random.default_rng([scene.seed, 12]))
        images = np.ascontiguousarray(images[:, ::-1]) if case.swapped else images
        controls.append(_judge(case, images, poses, scene, controls[0] if controls else None))
    return tuple(controls)


def _judge(case: _Case, images: NDArray, q: Array, scene: Scene, baseline: Control | None) -> Control:
    try:
        tracking = locate(images, case.told_rig, case.told_disc, scene.cameras.frame_rate_hz, apart=True)
    except TrackingError as error:
        alarm = f"refused: {str(error).split('.')[0]}"
        return Control(case.fault, case.must_be_noticed, (alarm,), np.nan, np.nan, True, True)
    trajectory = every(tracking.trajectory, 2)
    comparison = compare(trajectory, q)
    ok = comparison.found
    position, rotation = (float(np.sqrt(np.mean(comparison.error[ok, part] ** 2))) for part in _PARTS)
    larger = baseline is not None and (
        position > SAME * baseline.position or rotation > SAME * baseline.rotation or not ok.all()
    )
    return Control(
        case.fault,
        case.must_be_noticed,
        _alarms(tracking, comparison, trajectory.q, case.told_disc),
        position,
        rotation,
        claim_fails=position > CLAIM_POSITION or rotation > CLAIM_ROTATION,
        mattered=bool(larger),
    )


_PARTS = (slice(0, 3), slice(3, 6))


def _alarms(tracking: Tracking, comparison: PoseErrors, q: Array, disc: Disc) -> tuple[str, ...]:
    """What a user would see without knowing the truth."""
    alarms = [warning.split(":")[0] for warning in tracking.warnings]
    lost = float(1 - comparison.found.mean())
    if lost > LOST_ALLOWED:
        alarms.append(f"{100 * lost:.0f} % of the poses not found")
    shift = np.linalg.norm(tracking.as_built.marker_shift, axis=1)
    if shift.max() > ALARM_SHIFT:
        alarms.append(f"dot {int(shift.argmax())} refined by {1e3 * shift.max():.3f} mm")
    gap = q[:, 2] - disc.resting_height(q[:, 4])
    rms = float(np.sqrt(np.nanmean(gap**2)))
    if rms > ALARM_GAP:
        alarms.append(f"rim {1e3 * rms:.3f} mm off the table")
    return tuple(alarms)
