"""The rolling disc as a system to diagnose: dots in both images, predicted by the rolling model and the rig."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from disctrack.diagnosis.disc.motion import (
    SLIP,
    model_quantities,
    motion_candidates,
    slipping_start_quantities,
    state_of,
    state_quantities,
)
from disctrack.diagnosis.disc.optics import ellipse_centre_shift, measurement_candidates, predict
from disctrack.diagnosis.disc.stretch import Stretch, free_stretch
from disctrack.diagnosis.engine.fit import triangle
from disctrack.diagnosis.engine.system import Candidate, Quantity, Values
from disctrack.frames import euler_rate_axes_world, rotation_from_euler
from disctrack.rolling import Model, sensitivities, simulate
from disctrack.rolling.effects import Effect
from disctrack.track.pose import whitening
from disctrack.trajectory import MarkerStatus, Trajectory

Array = NDArray[np.float64]

RTOL = 1e-10  # of the integration: a millionth of the noise
THETA_END = np.radians(0.05)  # a trial fit may run into the collapse; the data end before it
MIN_NUISANCE = 0.1  # a direction of the rig's covariance that moves all dots together by less than this many sigmas
DOT_SIGMA = 3e-7  # [m] a common bias of one dot's centre in all images: 1/800 px, below what edges of dots allow
MAX_SWITCHES = (50, 200)  # and per second: slip at every extremum of a nutation of 30 Hz has 120; more is chatter
SLIP_STARTS = (0.9, 0.7, 0.5)  # of the friction that rolling needs at most
_CLOCK = ("time_offset.delay", "frame_rate.change")
_IMAGE = ("exposure_blur.T2", "ellipse_centre.share")


@dataclass(frozen=True)
class _Path:
    """Motion of the disc as each camera meets it."""

    q: Array  # (2, n, 6)
    qdot: Array  # (2, n, 6)
    names: tuple[str, ...]
    by_motion: Array  # (n, 6, k) pose components (rotation vector) by `names`


class DiscSystem:
    """Dots of a rolling disc in two cameras; samples are frames, a row holds the whitened numbers of all dots."""

    def __init__(
        self,
        trajectory: Trajectory,
        model: Model,
        candidates: tuple[Candidate, ...] | None = None,
        *,
        stretch: Stretch | None = None,
        starts_in_slip: bool = False,
    ) -> None:
        """Model : declared disc, gravity and effects; the parameters of its effects are fitted along.

        candidates : all of the catalogue and of the measurement, if not given
        stretch : frames to take; those of `free_stretch` if not given
        starts_in_slip : the velocity at the first instant is free, and so is the friction, unless the model declares it
        Raises AnalysisError.
        """
        self.stretch = stretch or free_stretch(trajectory)
        self.starts_in_slip = starts_in_slip
        rows = self.stretch.rows
        self.model = model
        self.trajectory = trajectory
        self.rig, self.disc = trajectory.rig, trajectory.disc
        self.rows = rows
        self.time = np.asarray(trajectory.time[rows], float)
        self.start_time = float(self.time[0])
        seen = (trajectory.marker_status[rows] == MarkerStatus.MEASURED) & np.isfinite(trajectory.markers_px[rows]).all(
            -1
        )
        self.used = seen & np.isfinite(trajectory.markers_covariance_px2[rows]).all((-1, -2))
        self._observed = np.where(self.used[..., None], trajectory.markers_px[rows], 0.0)
        safe = np.where(self.used[..., None, None], trajectory.markers_covariance_px2[rows], np.eye(2))
        self._whiten = np.where(self.used[..., None, None], whitening(safe), 0.0)
        self.weights = np.asarray(2.0 * self.used.sum((1, 2)), float)
        of_slip = slipping_start_quantities(model) if starts_in_slip else ()
        if candidates is None:
            candidates = (*motion_candidates(model), *measurement_candidates(self.disc))
        in_base = {q.name for q in of_slip}
        self.candidates = tuple(c for c in candidates if not in_base & set(c.names))
        nuisances, self._nuisance_columns = self._nuisances()
        self._nuisance_column = {q.name: i for i, q in enumerate(nuisances)}
        self.base = (*state_quantities(), *of_slip, *model_quantities(model), *nuisances)

    def _nuisances(self) -> tuple[tuple[Quantity, ...], Array]:
        """Errors common to all frames, with priors, and their whitened columns (n, 4 m, k).

        They are so small that their columns at the measured poses serve for every prediction. Directions of the
        calibration's covariance are in units of their own sigma.
        """
        q = np.array(self.trajectory.q[self.rows])
        known = np.isfinite(q).all(axis=1)
        q[~known] = q[np.argmax(known)]  # rows without a pose have no dots that count either
        R = rotation_from_euler(*q[:, 3:].T)
        points = self.disc.marker_centres_body @ np.swapaxes(R, 1, 2) + q[:, None, :3]
        _, by_point, by_rig = self.rig.project_with_jacobians(points)
        correlation, sigma = _scaled(self.rig.covariance)
        eigenvalues, vectors = np.linalg.eigh(correlation)
        root = sigma[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
        shift = (self._whiten @ by_rig).reshape(len(q), -1, root.shape[0]) @ root
        _, singular, V = np.linalg.svd(triangle(shift.reshape(-1, root.shape[1])))
        rig = shift @ V[singular > MIN_NUISANCE].T
        along = np.einsum("ncmap,npb->ncmab", by_point, R[:, :, :2])  # by the dots' places on the face
        m = self.disc.n_markers
        dots = (self._whiten @ along)[:, :, :, :, None, :] * np.eye(m)[None, None, :, None, :, None]
        meanings = ("direction of the calibration's covariance", "bias common to all images of a dot")
        quantities = [
            *(Quantity(f"rig.{k}", "sigma", 0.1, prior_sigma=1.0, meaning=meanings[0]) for k in range(rig.shape[-1])),
            *(
                Quantity(f"dot_{i}.{a}", "m", 1e-8, prior_sigma=DOT_SIGMA, meaning=meanings[1])
                for i in range(m)
                for a in "xy"
            ),
        ]
        return tuple(quantities), np.concatenate([rig, dots.reshape(len(q), -1, 2 * m)], axis=-1)

    def start(self, known: Values | None = None) -> dict[str, float]:
        """Values of the base quantities from the measured poses, good enough for Gauss-Newton.

        known : faults of the measurement that are held at these values
        """
        from disctrack.diagnosis.disc.start import start_values

        return start_values(self, known or {})

    def first_part(self, duration: float) -> DiscSystem:
        """The same system with the frames of the first `duration` [s] only."""
        part = copy(self)
        n = int(np.searchsorted(self.time, self.time[0] + duration, side="right"))
        part.rows = slice(self.rows.start, self.rows.start + n)
        for name in ("time", "used", "_observed", "_whiten", "weights", "_nuisance_columns"):
            setattr(part, name, getattr(self, name)[:n])
        return part

    def knowing(self, law: type[Effect]) -> DiscSystem:
        """The same system, in whose values parameters of this law may be named."""
        known = copy(self)
        known.model = self.model.knowing(law)
        return known

    def model_with(self, values: Values) -> Model:
        """The model with every effect that has an amount in `values`."""
        effects = {name: v for name, v in values.items() if self.model.has_name(name)}
        if values.get(SLIP, 0.0) > 0:
            effects["slip.mu"] = 1.0 / values[SLIP]
        return self.model.with_values(effects)

    def starts(self, candidate: Candidate, values: Values) -> Sequence[tuple[float, ...]]:
        """For slip: coefficients at which the fitted motion would slip seldom, often, and most of the time."""
        rate = 1.0 + values.get("frame_rate.change", 0.0)
        state = state_of(values)
        motion = simulate(self.model_with(values), state, times=self.start_time + (self.time - self.start_time) / rate)
        needed = float(np.max(motion.friction_needed))
        return [(1.0 / (share * needed),) for share in SLIP_STARTS]

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened dots (n, 4 m), observed minus predicted, and the prediction's derivative (n, 4 m, k)."""
        path = self._path(values, names)
        pixels, by_pose = self._pixels(path, values)
        residual = self._residual(pixels, values)
        derivative = np.zeros((*residual.shape, len(names)))
        column = {name: i for i, name in enumerate(names)}
        if path.names:
            whitened = (self._whiten @ by_pose).reshape(*residual.shape, 6)
            derivative[..., [column[n] for n in path.names]] = whitened @ path.by_motion
        common = [n for n in names if n in self._nuisance_column]
        if common:
            mine = self._nuisance_columns[..., [self._nuisance_column[n] for n in common]]
            derivative[..., [column[n] for n in common]] = mine
        for name, moved in self._measurement_columns(path, values, names, pixels, by_pose).items():
            derivative[..., column[name]] = self._rows_of(moved)
        return residual, derivative

    @property
    def observed(self) -> Array:
        """(n, 2, m, 2) measured dots [px]; 0 where not `used`."""
        return self._observed

    def pixels(self, values: Values, with_nuisances: bool = False) -> Array:
        """Predicted images of the dots (n, 2, m, 2) [px], with the biases that nuisances stand for if wanted."""
        pixels = self._pixels(self._path(values, ()), values)[0]
        if not with_nuisances:
            return pixels
        whitened = (self._nuisance_columns @ self._nuisance_values(values)).reshape(pixels.shape)
        inverse = np.linalg.inv(np.where(self.used[..., None, None], self._whiten, np.eye(2)))
        return pixels + np.where(self.used[..., None], (inverse @ whitened[..., None])[..., 0], 0.0)

    def poses(self, values: Values) -> Array:
        """Predicted coordinates q (n, 6) in the left camera's instants, in axes of the true table."""
        return self._path(values, ()).q[0]

    def pose_residual(self, values: Values) -> Array:
        """(n, 6) part of the whitened residual that a free pose per frame would take: six numbers of variance 1."""
        gradient, normal = self._pose_equations(values)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(normal), gradient[..., None])[..., 0], float)

    def pose_difference(self, values: Values) -> tuple[Array, Array]:
        """Measured minus predicted pose and its standard deviations, both (n, 6), POSE_COMPONENTS; NaN without dots.

        The difference that the dots show once everything else in `values` (cameras, pattern) is taken into account.
        """
        gradient, normal = self._pose_equations(values)
        covariance = np.linalg.inv(normal)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        delta = (covariance @ gradient[..., None])[..., 0]
        known = (self.weights >= 6)[:, None]
        return np.where(known, delta, np.nan), np.where(known, sigma, np.nan)

    def _pose_equations(self, values: Values) -> tuple[Array, Array]:
        """Gradient (n, 6) and normal matrix (n, 6, 6) of a free pose per frame, at the predicted poses."""
        pixels, by_pose = self._pixels(self._path(values, ()), values)
        r = self._residual(pixels, values)
        J = (self._whiten @ by_pose).reshape(len(r), -1, 6)
        normal = np.swapaxes(J, 1, 2) @ J
        normal[self.weights < 6] = np.eye(6)
        return (np.swapaxes(J, 1, 2) @ r[..., None])[..., 0], normal

    def _nuisance_values(self, values: Values) -> Array:
        return np.array([values.get(name, 0.0) for name in self._nuisance_column])

    def _residual(self, pixels: Array, values: Values) -> Array:
        """Whitened rows of observed minus predicted dots, the nuisances' part taken off."""
        residual = self._rows_of(self._observed - pixels)
        weights = self._nuisance_values(values)
        return residual - self._nuisance_columns @ weights if weights.any() else residual

    def _rows_of(self, pixels: Array) -> Array:
        return np.asarray((self._whiten @ pixels[..., None]).reshape(len(self.time), -1), float)

    def _path(self, values: Values, names: Sequence[str]) -> _Path:
        """Motion at the true instants of both cameras, and the derivatives that belong to it."""
        rate = 1.0 + values.get("frame_rate.change", 0.0)
        times = self.start_time + (self.time - self.start_time) / rate
        model = self.model_with({k: v for k, v in values.items() if np.isfinite(v)})
        components = [n.partition(".")[2] for n in names if n.startswith("state.")]
        present = set(model.values)
        parameters = [n for n in names if n in present or model.has_name(n)]
        parameters = [n for n in parameters if np.isfinite(values.get(n, 0.0))]
        slips = SLIP in names and values.get(SLIP, 0.0) > 0
        if slips:
            parameters.append("slip.mu")
        state = state_of(values)
        # a step of the fit may lead where no disc rolls, and where following it would take for ever
        fastest = 3 * np.sqrt(4 * model.gravity / (self.disc.radius * np.sin(THETA_END)))
        if not THETA_END < state.theta <= np.pi / 2 or max(abs(state.psidot), abs(state.omega3)) > fastest:
            return _nowhere(len(times))
        limit = int(MAX_SWITCHES[0] + MAX_SWITCHES[1] * (times[-1] - times[0]))
        found = sensitivities(model, state, times, parameters, components, THETA_END, RTOL, limit)
        axes = euler_rate_axes_world(found.q[:, 3], found.q[:, 4])
        by_motion = found.dq.copy()
        by_motion[:, 3:] = axes @ found.dq[:, 3:]
        all_names = (*(f"state.{c}" for c in components), *parameters)
        if slips:
            by_motion[..., -1] *= -1.0 / values[SLIP] ** 2
            all_names = (*all_names[:-1], SLIP)
        if "frame_rate.change" in names:
            speed = found.qdot.copy()
            speed[:, 3:] = (axes @ speed[:, 3:, None])[..., 0]
            column = -speed * ((self.time - self.start_time) / rate**2)[:, None]
            by_motion = np.concatenate([by_motion, column[..., None]], axis=-1)
            all_names = (*all_names, "frame_rate.change")
        delay = values.get("time_offset.delay", 0.0)
        q, qdot = np.stack([found.q] * 2), np.stack([found.qdot] * 2)
        if delay and np.isfinite(found.q).all():
            spline = CubicHermiteSpline(times, found.q, found.qdot)
            q[1], qdot[1] = spline(times + delay), spline(times + delay, 1)
        return _Path(q, qdot, all_names, by_motion)

    def _pixels(self, path: _Path, values: Values) -> tuple[Array, Array]:
        R = rotation_from_euler(path.q[..., 3], path.q[..., 4], path.q[..., 5])
        t = path.q[..., :3]
        images = predict(R, t, self.rig, self.disc, values)
        pixels = images.pixels
        if values.get("ellipse_centre.share", 0.0):
            pixels = pixels + values["ellipse_centre.share"] * ellipse_centre_shift(R[0], t[0], self.rig, self.disc)
        if values.get("exposure_blur.T2", 0.0):
            pixels = pixels + values["exposure_blur.T2"] / 24 * self._acceleration(pixels)
        return pixels, images.by_pose

    def _acceleration(self, pixels: Array) -> Array:
        """Second derivative of the dots' images [px/s^2] by differences over neighbouring frames."""
        return np.asarray(np.gradient(np.gradient(pixels, self.time, axis=0), self.time, axis=0), float)

    def _measurement_columns(
        self, path: _Path, values: Values, names: Sequence[str], pixels: Array, by_pose: Array
    ) -> dict[str, Array]:
        """Derivatives (n, 2, m, 2) by the quantities of the measurement among `names`."""
        R = rotation_from_euler(path.q[..., 3], path.q[..., 4], path.q[..., 5])
        t = path.q[..., :3]
        columns: dict[str, Array] = {}
        if "time_offset.delay" in names:
            axes = euler_rate_axes_world(path.q[1, :, 3], path.q[1, :, 4])
            speed = np.concatenate([path.qdot[1, :, :3], (axes @ path.qdot[1, :, 3:, None])[..., 0]], axis=1)
            columns["time_offset.delay"] = np.zeros_like(pixels)
            columns["time_offset.delay"][:, 1] = np.einsum("nmap,np->nma", by_pose[:, 1], speed)
        if "ellipse_centre.share" in names:
            columns["ellipse_centre.share"] = ellipse_centre_shift(R[0], t[0], self.rig, self.disc)
        if "exposure_blur.T2" in names:
            columns["exposure_blur.T2"] = self._acceleration(pixels) / 24
        steps = {q.name: q.scale for c in self.candidates if c.kind == "measurement" for q in c.quantities}
        for name in names:
            kind, _, axis = name.partition(".")
            if kind.startswith("misprint_"):
                i = int(kind.partition("_")[2])
                columns[name] = np.zeros_like(pixels)
                along = R[:, :, :, "xy".index(axis)]  # (2, n, 3) body axis in the world
                columns[name][:, :, i] = np.einsum("ncap,cnp->nca", by_pose[:, :, i, :, :3], along)
            elif name in steps and name not in (*_CLOCK, *_IMAGE):
                columns[name] = self._central_difference(R, t, values, name, steps[name])
        return columns

    def _central_difference(self, R: Array, t: Array, values: Values, name: str, step: float) -> Array:
        """By a quantity of `optics.predict`: smooth and nearly linear, so that this holds to 1e-8 of its size."""
        sides = []
        for sign in (1.0, -1.0):
            changed = dict(values) | {name: values.get(name, 0.0) + sign * step}
            sides.append(predict(R, t, self.rig, self.disc, changed).pixels)
        return (sides[0] - sides[1]) / (2 * step)


def _nowhere(n: int) -> _Path:
    """No motion at all."""
    nothing = np.full((2, n, 6), np.nan)
    return _Path(nothing, nothing, (), np.zeros((n, 6, 0)))


def _scaled(covariance: Array) -> tuple[Array, Array]:
    """Correlation matrix and standard deviations; zero rows stay zero."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(sigma > 0, sigma, 1.0)
    return covariance / np.outer(safe, safe), sigma
