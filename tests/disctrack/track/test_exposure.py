"""Exposures as long as the frame interval refer to their middle; light that is added shifts templates, and is told."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack import FrameStatus, frames, measure_pairs
from disctrack.findings import Kind, Severity
from disctrack.track.dots.template import Edge, NoiseModel
from disctrack.track.pose import dots_at
from disctrack.track.refine import dot_shifts as smears
from disctrack.track.refine.assembly import TrackingSettings
from disctrack.track.refine.dot_shifts import shift_by_exposure, shift_by_glare
from tests.oracles.flat_dots import covered, locate_in_window
from tests.rendering import render_disc, rolling_poses

RATE, EXPOSURE = 1000.0, 1e-3  # Hz, s
N = 40
SIMPSON = np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 24


def rolled(disc, theta_deg, rate=RATE):
    """A disc rolling at this nutation [deg]: its poses at nine instants of the exposure of each frame, (N, 9, 6)."""
    q, qdot = rolling_poses(disc, theta_deg, np.arange(8 * N + 1) / (8 * rate))
    return q[8 * np.arange(N)[:, None] + np.arange(9)], qdot[4::8]


@pytest.fixture(scope="module")
def motion(rendered_pairs):
    """At 10 deg."""
    return rolled(rendered_pairs.disc, 10)


def filmed(pairs, motion, seed, exposure=EXPOSURE, moving=True):
    """Images of the motion, or of the disc at rest in each of its poses at mid exposure."""
    q, qdot = motion
    scene = pairs.scene.changed(cameras={"exposure_s": exposure})
    rng = np.random.default_rng(seed)
    return render_disc(q[:, 4], pairs.rig, pairs.disc, scene, rng, qdot=qdot[:N] if moving else None)


def measured_with(images, pairs, exposure=None):
    return measure_pairs(images, pairs.rig, pairs.disc, RATE, settings=TrackingSettings(exposure=exposure))


@pytest.fixture(scope="module")
def measured(rendered_pairs, motion):
    """The poses at mid exposure; the same images measured with no exposure, theirs, an unknown and a wrong one."""
    images = filmed(rendered_pairs, motion, 3)
    told = [(0.0, 0.0), (EXPOSURE, EXPOSURE), None, (0.2e-3, 0.2e-3)]
    return motion[0][:, 4], [measured_with(images, rendered_pairs, exposure) for exposure in told]


def _against_drawn_dots(q, chosen, pairs, look, rate=RATE, lost=()):
    """Shifts of the template by the smear, by dots drawn along the motion; by the mean of their path; as corrected.

    Before them their size [px], after them the corrections of all frames. lost : frames without a pose
    """
    rig, disc, R = pairs.rig, pairs.disc, frames.rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0))
    known, where, radius = R[:, 4].copy(), q[:, 4, :3].copy(), 0.5 * disc.marker_diameter
    known[[*lost]], where[[*lost]] = np.nan, np.nan
    dots = dots_at(known, where, rig, disc)
    found = shift_by_exposure(*dots, np.arange(N) / rate, np.full(2, 1 / rate), radius, (look, look))
    expected, by_path, given = [], [], []
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    edge = radius * np.column_stack([circle, np.zeros(16)])
    for frame, dot, cameras in chosen:
        points = np.concatenate([disc.marker_centres_body[[dot]], disc.marker_centres_body[dot] + edge])
        outlines = rig.project(points @ np.swapaxes(R[frame], -1, -2) + q[frame, :, None, :3])  # (9, 2, 17, 2)
        for camera in cameras:
            centres, edges = outlines[:, camera, 0], outlines[:, camera, 1:]
            affine = np.swapaxes(edges - centres[:, None], 1, 2) @ circle / 8
            window = np.round(centres[4]) - 31
            cover = [covered(centres[k] - window, affine[k], 0.6, SIMPSON) for k in (np.arange(9), [4] * 9)]
            at = {"centre": centres[4], "affine": affine[4], "noise": look.noise, "blur_px": look.blur_px}
            images = (look.level * (1 - look.contrast * share) for share in cover)
            smeared, still = (locate_in_window(image, **at).pixels[0] for image in images)
            expected.append(smeared - still)
            by_path.append(SIMPSON @ centres - centres[4])
            given.append(found[frame, camera, dot])
    size = np.sqrt(np.mean(np.square(expected)))
    assert size > 0.002
    return size, np.array(expected), np.array(by_path), np.array(given), found


@pytest.mark.statistical
@pytest.mark.parametrize(("dark", "noise"), [(10000, NoiseModel(4e5, 0.0)), (5000, NoiseModel(1e4, 8.0))])
def test_the_shift_is_that_of_the_template(motion, rendered_pairs, dark, noise):
    """Against dots drawn along the simulated motion (no renderer, no formula), found by their template."""
    dots = ((3, 0), (9, 1), (14, 2), (28, 3), (33, 4), (37, 0), (6, 2), (11, 4))
    chosen = [(*dot, (0, 1)) for dot in dots]
    edge = Edge(0.65, 50000.0, 1 - dark / 50000, noise)
    size, expected, by_path, given, found = _against_drawn_dots(motion[0], chosen, rendered_pairs, edge, lost=[20])
    assert not found[20].any()
    assert np.sqrt(np.mean((given - expected) ** 2)) < 0.25 * size
    assert np.sqrt(np.mean((by_path - expected) ** 2)) > 0.4 * size  # the mean of the path alone is not what is found


@pytest.mark.statistical
def test_a_dot_seen_obliquely_is_pulled_as_an_ellipse(rendered_pairs):
    """At 55 deg of nutation, dots up to 75 deg off their normal."""
    rate = 2500.0  # a millisecond would smear them by more than a blur
    q = rolled(rendered_pairs.disc, 55, rate)[0]
    R_cw, t_cw = rendered_pairs.rig.camera_poses()[0]
    to_camera = -t_cw @ R_cw - q[N // 2, 4, :3]
    towards, now = np.arctan2(to_camera[1], to_camera[0]), q[N // 2, 4, 3] - np.pi / 2  # of the camera, of the normal
    q[..., 3] += towards + np.radians(98) - now
    R = frames.rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0))
    line = q[:, 4, :3] @ R_cw.T + t_cw
    cosine = -((R_cw @ R[:, 4])[..., 2] * line).sum(-1) / np.linalg.norm(line, axis=-1)
    oblique = [(int(frame), 0, (0,)) for frame in np.flatnonzero((cosine > 0.27) & (cosine < 0.5))[1:-1:2]]
    assert len(oblique) >= 4
    edge = Edge(0.7, 50000.0, 0.8, NoiseModel(4e5, 0.0))
    size, expected, _, ellipses, _ = _against_drawn_dots(q, oblique, rendered_pairs, edge, rate)
    # single dots scatter by 7e-4 px, with the place of their edge among the pixels that they are drawn with
    assert np.sum(expected * ellipses) / np.sum(ellipses**2) == pytest.approx(1.0, abs=0.12)
    assert np.sqrt(np.mean((ellipses - expected) ** 2)) < 0.35 * size  # as circles of the same area above 0.5


@pytest.mark.statistical
def test_theta_is_that_of_mid_exposure(measured, rendered_pairs):
    q, runs = measured
    expected = -9.81 * EXPOSURE**2 / (6 * rendered_pairs.disc.radius)  # steady precession, dot_shifts.py
    none, told, smeared, _ = (run.trajectory for run in runs)
    errors = [trajectory.q[:, 4] - q[:, 4] for trajectory in (none, told, smeared)]
    sigma = np.sqrt(np.mean(none.pose_covariance[:, 3, 3] + none.pose_covariance[:, 4, 4]) / 2 / N)
    assert abs(expected) > 8 * sigma
    # the fault is there when it is said to be nil; told, and told by nobody
    assert_allclose(np.mean(errors, axis=1), [expected, 0.0, 0.0], rtol=0, atol=4 * sigma)


def said_of(run, severity):
    found = run.trajectory.findings
    return [f.text for f in found if (f.kind, f.severity) == (Kind.EXPOSURE, severity)]


@pytest.mark.statistical
def test_the_smear_tells_the_exposure(measured):
    _, (none, told, smeared, wrong) = measured
    assert smeared.details["exposure_s"] == pytest.approx([EXPOSURE, EXPOSURE], rel=0.1)
    assert "exposure by the smear" in said_of(smeared, Severity.NOTE)[0]
    assert told.details["exposure_s"] == [EXPOSURE, EXPOSURE]
    assert not said_of(told, Severity.WARNING)
    for run, said in ((none, "0 and 0 µs"), (wrong, "200 and 200 µs")):
        (warning,) = said_of(run, Severity.WARNING)
        assert said in warning


def test_a_blur_that_changes_with_obliqueness_is_no_exposure(motion, rendered_pairs):
    """Of 2e-4 px, as curved edges have; a dot's smear by 200 µs is some 1e-3 px of blur."""
    q, rig, disc = motion[0][:, 4], rendered_pairs.rig, rendered_pairs.disc
    R = frames.rotation_from_euler(*q[:, 3:].T)
    pixels, affine = dots_at(R, q[:, :3], rig, disc)
    time = np.arange(N) / RATE
    smear = 200e-6**2 * smears._smear(np.gradient(pixels, time, axis=0), affine)
    singular = np.linalg.svd(affine, compute_uv=False)
    oblique = singular[..., 1] / singular[..., 0]
    blur = np.sqrt(0.7**2 + smear) + 2e-4 * (oblique - oblique.mean()) / oblique.std()
    found, _ = smears.exposure_by_smear(pixels, affine, time, blur.astype(np.float32))
    assert np.sqrt(found) == pytest.approx(200e-6, rel=0.02)


@pytest.mark.statistical
def test_no_smear_where_nothing_was_smeared(rendered_pairs, motion):
    """Negative control: the same motion frozen at mid exposure, and as an exposure too short to be seen."""
    for exposure, moving in ((EXPOSURE, False), (20e-6, True)):
        run = measured_with(filmed(rendered_pairs, motion, 4, exposure, moving), rendered_pairs)
        assert run.details["exposure_s"] == [0.0, 0.0]
        assert said_of(run, Severity.NOTE) == []


@pytest.mark.statistical
def test_noise_hardly_grows(measured):
    without, *corrected = (run.trajectory for run in measured[1][:3])
    for each in corrected:
        scatter = [np.std(np.diff(run.markers_px, n=3, axis=0)) for run in (without, each)]
        assert scatter[1] == pytest.approx(scatter[0], rel=0.05)
        assert (each.frame_status == FrameStatus.MEASURED).all()


SHOTS, DARK, PAPER, NOISE = 24, 8000.0, 50000.0, NoiseModel(1e4, 8.0)


@pytest.fixture(scope="module")
def located(rendered_pairs):
    """Contrast and shift of the left camera's dots under light that falls off, and under that with glare."""
    rig, disc = rendered_pairs.rig, rendered_pairs.disc
    q, _ = rolling_poses(disc, 15, np.arange(SHOTS) / 200)
    R, t = frames.rotation_from_euler(*q[:, 3:].T), q[:, :3]
    radius, (pixels, maps) = 0.5 * disc.marker_diameter, dots_at(R, t, rig, disc)
    affine = radius * maps[:, 0]
    middle = pixels[:, 0].mean(axis=(0, 1))
    y, x = np.mgrid[:64, :64]
    found = {}
    for kind, glare in (("falls off", 0.0), ("glare", 3000.0)):
        contrast = np.full((SHOTS, 2, disc.n_markers), np.nan, np.float32)
        shift = np.zeros((SHOTS, disc.n_markers, 2))
        for frame in range(SHOTS):
            for dot in range(disc.n_markers):
                centre, A = pixels[frame, 0, dot], affine[frame, dot]
                window = np.round(centre) - 31
                plain = PAPER - (PAPER - DARK) * covered([centre - window], [A], 0.6)
                place = np.stack([x, y], axis=-1) + window - middle
                added = glare * np.exp(-0.5 * np.sum((place - [30, -20]) ** 2, axis=-1) / 70.0**2)
                lit = plain * (1 - 4e-4 * place @ [1.0, 0.5]) + added
                of_plain, of_lit = (locate_in_window(image, centre, A, noise=NOISE) for image in (plain, lit))
                shift[frame, dot] = (of_lit.pixels - of_plain.pixels)[0]
                contrast[frame, 0, dot] = of_lit.dots["contrast"][0]
        found[kind] = contrast, shift
    edge = Edge(0.65, PAPER, 1 - DARK / PAPER, NOISE)

    def told(contrast, frames=slice(None)):
        return shift_by_glare(pixels[frames], maps[frames], contrast[frames], radius, (edge, edge))

    return found, told


def test_glare_shifts_dots_and_their_contrasts_tell_by_how_much(located):
    found, told = located
    contrast, shift = found["glare"]
    given = told(contrast)
    assert np.sqrt(np.mean(shift**2)) > 0.002  # px
    # single dots scatter with the place of their edge among the pixels
    assert np.sqrt(np.mean((given[:, 0] - shift) ** 2)) < 0.2 * np.sqrt(np.mean(shift**2))
    assert not given[:, 1].any()  # the camera in which no dot was seen


def test_light_that_falls_off_shifts_nothing(located):
    found, told = located
    contrast, shift = found["falls off"]
    assert np.sqrt(np.mean(shift**2)) < 1e-4  # px; single ones 5e-4, where another pixel counts to the edge
    assert np.abs(told(contrast)).max() < 2e-4


def test_flicker_and_dots_of_different_ink_are_no_gradient(located, rng):
    found, told = located
    contrast = found["glare"][0]
    uneven = contrast + 0.03 * rng.normal(size=(SHOTS, 1, 1)) + 0.03 * rng.normal(size=contrast.shape[2])
    assert np.abs(told(uneven.astype(np.float32)) - told(contrast)).max() < 2e-4  # px


def test_what_a_resting_disc_repeats_is_no_evidence(located, rng):
    """Copies of the first and last frame, each with one error of the contrasts, that outnumber the motion."""
    found, told = located
    contrast = found["falls off"][0] + 0.003 * rng.normal(size=(SHOTS, 1, 6)).astype(np.float32)
    rests = np.r_[np.zeros(100, int), np.arange(SHOTS), np.full(100, SHOTS - 1)]
    assert_array_equal(told(contrast, rests), told(contrast)[rests])
    assert not told(contrast, np.zeros(200, int)).any()
    assert told(np.full_like(contrast, np.nan)).shape == (SHOTS, 2, 6, 2)


def test_a_disc_at_rest_or_a_single_dot_tells_nothing(located):
    _, told = located
    contrast = np.full((SHOTS, 2, 6), np.nan, np.float32)
    contrast[:, :, 2] = 0.8
    assert not told(contrast).any()
