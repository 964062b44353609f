"""Declared numbers against the motion: true motions pass, and a wrong number is named first.

The motions are integrated in conftest.py and the dots projected here by the pinhole formula: nothing is shared with
the balance of moments under test.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from disctrack import MarkerStatus, Trajectory, frames
from disctrack.analyse import declaration
from disctrack.analyse.declaration import contradictions
from disctrack.findings import Kind, Severity
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from tests.physics.conftest import as_tracked, true_motion

SIXTHS = np.radians(60.0 * np.arange(6))
HONEST = [  # theta [deg], seconds, losses, nutation, spin [rad/s]
    (3.3, 0.3, 0.381e-7, 0.05, 0.0),
    (10.0, 0.2, 0.381e-7, 0.2, 1.0),
    (25.0, 0.2, 2e-7, 0.05, 3.0),
    (45.0, 0.3, 0.0, 0.1, 0.0),
]


def at_another_rate(trajectory: Trajectory, factor: float) -> Trajectory:
    """The same frames, declared to be `factor` times as many a second."""
    return replace(trajectory, frame_rate=trajectory.frame_rate * factor, time=trajectory.time / factor)


@pytest.fixture(scope="module")
def honest():
    return as_tracked(true_motion(8.0, 0.16, nutation=0.1), np.random.default_rng(4))


@pytest.fixture(params=HONEST)
def any_honest(request):
    """Each of these motions, with a gap."""
    *course, spin = request.param
    return as_tracked(true_motion(*course, spin=spin), np.random.default_rng(1), missing=range(50, 58))


@pytest.mark.statistical
def test_honest_motions_are_not_contradicted(any_honest):
    gravity, _ = declaration.balance(any_honest)
    assert contradictions(any_honest) == ()
    assert len(gravity) >= 8
    sigma = np.std(gravity) / np.sqrt(len(gravity))
    assert abs(np.median(gravity) / 9.81 - 1) < max(5 * sigma / 9.81, 2e-3)


@pytest.mark.parametrize(
    ("wrong", "key", "true", "hint"),
    [
        *[(lambda t, f=f: at_another_rate(t, f), "[cameras] frame_rate_hz", 1000.0, "1000 is usual")
          for f in (2.0, 0.5, 1.1, 0.9)],
        *[(lambda t, g=g: replace(t, gravity=g), "[gravity] g_m_s2", 9.81, hint)
          for g, hint in ((9810.0, "mm/s²"), (1.62, ""), (98.1, ""))],
        # the balance of moments alone knows radius / rate^2: that the rim is on the table tells which of the two it is
        *[(lambda t, f=f: replace(t, disc=replace(t.disc, radius=f * t.disc.radius)), "[disc] radius_mm", 37.5, "")
          for f in (2.0, 10.0)],
    ],
)  # fmt: skip
def test_a_number_that_the_balance_of_moments_contradicts_is_named_with_the_true_one(wrong, key, true, hint, honest):
    kind = Kind.RADIUS if "radius" in key else Kind.GRAVITY_OR_RATE
    finding = next(f for f in contradictions(wrong(honest)) if f.kind == kind)
    assert finding.remedies[0].key == key
    assert abs(float(finding.remedies[0].fits) / true - 1) < 2e-3
    assert hint in finding.sentence
    assert finding.doubtful


@pytest.mark.parametrize("turn_deg", [3.0, 25.0])
def test_a_table_view_whose_board_did_not_lie_on_the_table_is_named(turn_deg, any_honest):
    """Before, the radius was said to be 0.5 mm: over another plane the height of the centre means nothing."""
    # the same motion in a world that leans and lies lower
    Q = frames.rotation_from_vector(np.radians(turn_deg) * np.array([0.6, -0.8, 0.0]))
    R = Q @ frames.rotation_from_quaternion(any_honest.quaternion)
    position, angles = any_honest.q[:, :3] @ Q.T + [0.0, 0.0, 0.02], frames.euler_from_rotation(R)
    q, quaternion = np.column_stack([position, frames.unwrap_euler(angles)]), frames.quaternion_from_rotation(R)
    quaternion = frames.continuous_quaternions(quaternion)
    (finding,) = contradictions(replace(any_honest, q=q, quaternion=quaternion))
    assert finding.remedies[0].key == "[table] view"
    assert f"turned by {turn_deg:.1f} deg" in finding.sentence
    assert finding.doubtful


def test_departures_that_a_table_or_an_edge_may_make_are_noted_and_no_contradiction(honest):
    for trajectory, key, true in (
        (at_another_rate(honest, 1.03), "[cameras] frame_rate_hz", 1000.0),
        (replace(honest, gravity=9.81 * 0.97), "[gravity] g_m_s2", 9.81),
    ):
        (finding,) = contradictions(trajectory)
        assert (finding.kind, finding.severity) == (Kind.GRAVITY_OR_RATE, Severity.NOTE)
        assert abs(next(float(r.fits) for r in finding.remedies if r.key == key) / true - 1) < 2e-3
    assert contradictions(replace(honest, gravity=9.81 * 0.995)) == ()


@pytest.mark.parametrize(("theta", "seconds"), [(3.3, 0.3), (9.0, 0.1)])
def test_a_film_that_runs_backwards_gains_energy(theta, seconds):
    """However short: by 2 %, which is many of its sigmas."""
    motion = true_motion(theta, seconds)
    forwards = as_tracked(motion, np.random.default_rng(2))
    backwards = replace(forwards, q=forwards.q[::-1], quaternion=forwards.quaternion[::-1])
    assert contradictions(forwards) == ()
    (finding,) = contradictions(backwards)
    assert finding.kind == Kind.REVERSED
    assert "in the order of time" in finding.sentence


@pytest.mark.statistical
def test_a_push_between_the_stretches_that_are_looked_at_is_no_film_that_runs_backwards():
    """It raises the energy once; a disc that hardly loses any rolls before and after it."""
    before, after = (true_motion(theta, 0.302, 1e-9) for theta in (10.0, 12.0))
    parts = {k: np.concatenate([getattr(m, k)[:300] for m in (before, after)]) for k in ("R_world_body", "position")}
    pushed = as_tracked(replace(before, time=1e-3 * np.arange(600), **parts), np.random.default_rng(0))
    gravity, energy = declaration.balance(pushed)
    assert energy[-5:].mean() > 1.05 * energy[:5].mean()
    assert abs(np.median(gravity) / 9.81 - 1) < 2e-3
    assert declaration.motion_against_gravity(pushed) == ()


def test_a_hand_that_turns_the_disc_and_a_disc_at_rest_give_no_verdict():
    """What the table's force alone does not explain says nothing about gravity."""
    motion = true_motion(10.0, 0.2)
    psi = 20.0 * motion.time
    axes = np.stack([np.cos(psi), np.sin(psi), 0 * psi], -1)
    e3 = np.stack([np.sin(psi) * 0.2, -np.cos(psi) * 0.2, np.full(len(psi), np.sqrt(0.96))], -1)
    R = np.stack([axes, np.cross(e3, axes), e3], -1)
    held = replace(motion, R_world_body=R, position=motion.position[:1] + 0 * e3)
    resting = replace(held, R_world_body=np.broadcast_to(R[0], R.shape))
    for motion in (held, resting):
        assert not [f for f in contradictions(as_tracked(motion, np.random.default_rng(3))) if f.kind != Kind.RADIUS]


@pytest.mark.statistical
@pytest.mark.parametrize("memory_ms", [15, 40, 100])
def test_no_hand_is_taken_for_a_wrong_number(memory_ms):
    """However a hand turns and lifts the disc, alone and after it has rolled; nor is a pose that never moves."""
    rolled = true_motion(10.0, 0.149)

    def wander(rng, size, n=400):
        smooth = gaussian_filter1d(rng.normal(size=(n + 8 * memory_ms, 3)), memory_ms, axis=0)[4 * memory_ms :][:n]
        return size * smooth / smooth.std(axis=0)

    for seed in range(4):
        rng = np.random.default_rng(seed)
        start = frames.rotation_from_euler(rng.uniform(0, 6), np.radians(rng.uniform(5, 50)), 0.3)
        R = frames.rotation_from_vector(wander(rng, rng.uniform(0.02, 0.3))) @ start
        position = wander(rng, 5e-3) + np.array([0.05, 0.04, 0.05])
        for before in (0, 150):
            parts = {"R_world_body": R, "position": position, "time": 1e-3 * np.arange(before, before + len(R))}
            joined = {k: np.concatenate([getattr(rolled, k)[:before], v]) for k, v in parts.items()}
            found = contradictions(as_tracked(replace(rolled, **joined), rng))
            assert {finding.kind for finding in found} <= {Kind.CLOCK_JUMP}  # from rolling to the hand in one frame
        still = replace(rolled, R_world_body=np.tile(start, (150, 1, 1)), position=np.tile(position[0], (150, 1)))
        assert contradictions(as_tracked(still, rng, noise=0.0)) == ()


def with_dots(trajectory: Trajectory, scale: float, unseen: tuple[int, ...] = ()) -> Trajectory:
    """Half a metre before the cameras, with the images of dots `scale` times as far apart as declared."""
    R = frames.rotation_from_quaternion(trajectory.quaternion)
    points = scale * trajectory.disc.marker_centres_body @ R.swapaxes(1, 2)
    points = points + trajectory.q[:, None, :3] + [0.0, 0.0, 0.5]
    pixels = np.stack([1000.0 * (points + t)[..., :2] / points[..., 2:] + 255.5 for t in ([0, 0, 0], [-0.2, 0, 0])], 1)
    status = np.full(pixels.shape[:3], MarkerStatus.MEASURED, np.uint8)
    status[:, :, list(unseen)] = MarkerStatus.LOW_CONTRAST
    pixels = pixels + np.random.default_rng(6).normal(0, 0.03, pixels.shape)
    return replace(trajectory, markers_px=pixels, marker_status=status)


@pytest.mark.parametrize("scale", [6.0 / 6.1, 6.1 / 6.0])
def test_a_chessboard_of_another_scale_is_told_from_the_dots(scale, honest):
    (finding,) = contradictions(with_dots(honest, scale))
    assert finding.kind == Kind.SQUARE
    square = next(r for r in finding.remedies if r.key == "[calibration] square_mm")
    assert abs(float(square.action.split()[1]) * scale - 1) < 1e-3
    # the true square of a board is named first
    known = declaration.other_scale(finding.numbers["scale"], 6e-3 * scale)
    assert known.remedies[0].key == "[calibration] square_mm"
    assert abs(float(known.remedies[0].fits) - 6.0) < 5e-3


def test_dots_on_the_boards_scale_but_for_printing_are_fine(honest):
    assert contradictions(with_dots(honest, 1.0)) == contradictions(with_dots(honest, 1.002)) == ()


def test_a_dot_without_which_the_layout_repeats_spoils_the_spin_angle(honest):
    assert not contradictions(with_dots(honest, 1.0, unseen=(1,)))[0].doubtful
    hexagon = honest.disc.marker_centres_body.copy()
    hexagon[:, :2] = 0.03 * np.column_stack([np.cos(SIXTHS), np.sin(SIXTHS)])
    seventh = np.vstack([hexagon, hexagon[:1] * [0.4, 0.4, 1.0]])
    disc = replace(honest.disc, marker_centres_body=seventh)
    (finding,) = declaration.unseen_dots(with_dots(replace(honest, disc=disc), 1.0, unseen=(6,)), disc)
    assert finding.doubtful, "six dots in a hexagon are left"


def cameras_at(left_deg, right_deg, off_vertical_deg=(40.0, 40.0)):
    """Cameras in these directions from the middle of the table, at which they look."""
    placed = {"azimuth_deg": (left_deg, right_deg), "off_vertical_deg": off_vertical_deg, "variation": 0.0}
    return rig_of(Scene().changed(rig=placed))


@pytest.mark.parametrize("turn_deg", [0.0, 57.0, 143.0, 229.0])
def test_a_mirrored_world_is_told_by_the_cameras_places_or_by_dots_without_an_axis(turn_deg, honest):
    left_deg, right_deg = turn_deg - 110.0, turn_deg - 70.0
    assert declaration.handedness(cameras_at(left_deg, right_deg), honest.disc) == ()
    mirrored = cameras_at(-left_deg, -right_deg)
    (finding,) = declaration.handedness(mirrored, honest.disc)
    assert finding.doubtful
    assert "mirrored" in finding.sentence
    assert "exchanged" in finding.sentence
    asymmetric = honest.disc.marker_centres_body.copy()
    asymmetric[0, :2] *= 0.6
    lopsided = replace(honest.disc, marker_centres_body=asymmetric)
    assert declaration.handedness(mirrored, lopsided) == ()


def test_cameras_that_face_each_other_tell_no_left_and_right(honest):
    across, above = cameras_at(0.0, 179.0), cameras_at(-90.0, -90.0, (1.0, 34.0))
    assert declaration.handedness(across, honest.disc) == declaration.handedness(above, honest.disc) == ()


def test_a_dot_that_is_not_seen_costs_precision_and_a_rate_spoils_every_velocity(honest):
    dot, rate = contradictions(with_dots(at_another_rate(honest, 2.0), 1.0, unseen=(0,)))
    assert (dot.kind, dot.severity) == (Kind.DOT_UNSEEN, Severity.WARNING)
    assert (rate.kind, rate.severity) == (Kind.GRAVITY_OR_RATE, Severity.DOUBT)
