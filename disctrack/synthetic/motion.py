"""Pose of the disc of a scene at any instant: at rest, from a table, or from the rolling model."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PPoly

from disctrack.errors import SceneError, told_as
from disctrack.rolling import Model, Motion, State, effects_from_tables, simulate, steady_precession, struck_disc
from disctrack.synthetic.description import RollingMotion, Scene

_SAMPLES_PER_FRAME = 4  # of the simulated motion; error of cubic interpolation: 3e-8 of a nutation oscillation


def true_frame_rate(scene: Scene) -> float:
    """True frame rate of the cameras [Hz]."""
    return scene.faults.frame_rate_hz or scene.cameras.frame_rate_hz


def true_exposure(scene: Scene) -> float:
    """True exposure of a frame [s]."""
    return scene.faults.exposure_s or scene.cameras.exposure_s


def motion_of(scene: Scene) -> tuple[PPoly, int]:
    """Motion of the scene, q (k, 6) at times (k,) [s], and the number of frames that it covers.

    SI and radians, angles not wrapped. Raises SceneError if there is no such motion.
    """
    return {"static": _static, "table": _table, "rolling": _rolling}[scene.motion.kind](scene)


def _static(scene: Scene) -> tuple[PPoly, int]:
    q = np.array(scene.motion.poses) * np.r_[np.full(3, 1e-3), np.full(3, np.pi / 180)]
    return PPoly(q[None], (np.arange(len(q) + 1) - 0.5) / true_frame_rate(scene)), len(q)


def _table(scene: Scene) -> tuple[PPoly, int]:
    path = scene.folder / scene.motion.table
    remedy = "Expected are rows t, x, y, z, psi, theta, phi."
    with told_as(SceneError, f"{path}: no table of motion", OSError, ValueError, then=remedy):
        rows = np.load(path) if path.suffix == ".npy" else np.loadtxt(path, delimiter=",", ndmin=2)
    if rows.ndim != 2 or rows.shape[1] != 7 or len(rows) < 2 or not (np.diff(rows[:, 0]) > 0).all():
        raise SceneError(f"{path}: shape {rows.shape}; expected 2 or more rows of 7 with increasing t [s]")
    if not np.isfinite(rows).all():
        raise SceneError(f"{path}: row {np.flatnonzero(~np.isfinite(rows).all(axis=1))[0]} holds no finite number")
    n = _frames_within(scene, rows[0, 0], rows[-1, 0], str(path))
    return CubicSpline(rows[:, 0], rows[:, 1:]), n


def _rolling(scene: Scene) -> tuple[PPoly, int]:
    motion = simulate_scene(scene)
    if len(motion) < 2:
        raise SceneError(f"the rolling model: over before anything is filmed: {motion.end.value}")
    n = _frames_within(scene, motion.time[0], motion.time[-1], "the rolling model")
    return CubicHermiteSpline(motion.time, motion.q, motion.qdot), n


def _margin(scene: Scene) -> tuple[float, float]:
    """Duration of the motion before the first and after the last mid exposure of the left camera [s]."""
    half, delay = true_exposure(scene) / 2, scene.faults.right_delay_s
    return half + max(-delay, 0.0), half + max(delay, 0.0)


def _frames_within(scene: Scene, start: float, end: float, source: str) -> int:
    before, after = _margin(scene)
    if start > -before + 1e-9:
        raise SceneError(f"{source}: begins at {start:g} s, after the first exposure at {-before:g} s; begin earlier")
    rate = true_frame_rate(scene)
    exposed = scene.faults.true_times(np.arange(scene.cameras.n_frames) / rate, rate)
    n = int(np.sum(exposed <= end - after + 1e-6 / rate))
    if n < 1:
        raise SceneError(f"{source}: ends at {end:g} s, before the first frame is exposed")
    return n


def rolling_model(scene: Scene) -> Model:
    """Declared disc and gravity with the scene's effects; raises ModelError for an effect that does not exist."""
    settings = scene.motion.rolling
    effects = effects_from_tables(settings.effects, settings.formulas)
    return Model(scene.declared_disc, scene.gravity_m_s2, effects, scene.air_density_kg_m3)


def effects_in_words(scene: Scene) -> str:
    """The effects of a rolling scene with their sizes, and the default effects that it lacks."""
    model = rolling_model(scene)
    named = ", ".join(f"{k} = {v:g} {model.parameters[k].unit}" for k, v in model.values.items()) or "none"
    without = ", ".join(name for name in RollingMotion().effects if model.effect(name) is None)
    return f"{named}; without {without}, which only a scene that names no effect has" if without else named


def rolling_start(scene: Scene) -> State:
    """Initial state: regular precession with a nutation oscillation, modified by the scene's `state`.

    With `struck` it is the upright disc just after the impact of a ball.
    """
    start, disc = scene.motion.rolling, scene.declared_disc
    x, y = np.array(start.centre_mm) * 1e-3
    place = {"psi": np.radians(start.psi_deg), "phi": np.radians(start.phi_deg), "x": x, "y": y}
    if start.struck:
        wanted, given = {"lateral_mm", "vertical_mm", "impulse_N_s"}, set(start.struck)
        if not wanted <= given <= wanted | {"friction"}:
            raise SceneError(
                f"motion.rolling.struck has {', '.join(sorted(given))}; expected {', '.join(sorted(wanted))} and, "
                "if wanted, friction"
            )
        hit = [start.struck["lateral_mm"] * 1e-3, start.struck["vertical_mm"] * 1e-3, start.struck["impulse_N_s"]]
        return struck_disc(disc, *hit, friction=start.struck.get("friction", 0.0), psi=place["psi"]).moved(**place)
    if unknown := set(start.state) - set(State.__dataclass_fields__):
        known = ", ".join(State.__dataclass_fields__)
        raise SceneError(f"motion.rolling.state: unknown {', '.join(sorted(unknown))}; a state has {known}")
    regular = steady_precession(
        np.radians(start.theta_deg),
        disc,
        scene.gravity_m_s2,
        omega3=None if np.isnan(start.omega3_rad_s) else start.omega3_rad_s,
        nutation_amplitude=np.radians(start.nutation_deg),
        nutation_phase=np.radians(start.nutation_phase_deg),
    )
    return regular.moved(**place | start.state)


def simulate_scene(scene: Scene) -> Motion:
    """The motion of the rolling model, four samples per frame; it ends early if the disc comes to rest."""
    before, after = _margin(scene)
    step = 1 / (_SAMPLES_PER_FRAME * true_frame_rate(scene))
    first = -int(np.ceil(before / step + 1e-9))
    last = _SAMPLES_PER_FRAME * (scene.cameras.n_frames - 1) + int(np.ceil(after / step + 1e-9))
    times = np.arange(first, max(last, first + 1) + 1) * step
    return simulate(rolling_model(scene), rolling_start(scene), times=times)
