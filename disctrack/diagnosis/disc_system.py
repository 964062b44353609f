"""The rolling disc as a system for the search: dots in both images, predicted by the rolling model and the rig."""

from collections.abc import Iterator, Sequence, Set
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array
from disctrack.diagnosis import motion
from disctrack.diagnosis.law_library import LearnedLaw
from disctrack.diagnosis.starts import STRETCHES, shape_guesses, start_values
from disctrack.diagnosis.stretch import free_stretch
from disctrack.diagnosis.systematic import DOT_SIGMA, Systematic, field_columns
from disctrack.discrepancy.held_out import square_root
from disctrack.discrepancy.system import Budget, Candidate, Quantity, System, Values
from disctrack.faults.catalogue import faults_of, scene_faults
from disctrack.faults.dots import Sight, predict
from disctrack.frames import euler_jacobian, euler_rate_axes_world, rotation_from_euler
from disctrack.rolling import Effort, Model, sensitivities, simulate
from disctrack.track.pose import whitening
from disctrack.track.refine.table_contact import ASSUMED_THICKNESS as MICROMETER
from disctrack.track.refine.table_contact import thickness_tolerance
from disctrack.trajectory import MarkerStatus, Trajectory

RTOL = 1e-10  # of the integration: a millionth of the noise
MIN_NUISANCE = 0.1  # sigmas by which a direction of the rig's covariance moves all dots together at least
MAX_SWITCHES = (50, 200)  # and per second: slip at every extremum of a nutation of 30 Hz has 120; more is chatter
# creep at small slip is stiff: its time constant is v / (3 mu g), and steps of the integrator have to be as short
TRIAL_WORK = 1_000  # per frame, in one trial fit of many; true slip takes hundreds
ROLLS = 0.2  # of that in one motion that cannot slip: for laws of vanishing width, or that accelerate the disc for ever
MOST_WORK = 12_000  # per frame: steps of the integrator and rows of derivatives, 5 to 10 us each; some laws take half
USUAL = 700  # frames, below which a recording may take as much work as with so many
MOST_SIGMAS = 10.0  # of a size's tolerance, which bound its fit: it must not compensate for a wrong clock
REMEMBERED = 8  # points of fits to so many frames: a trial begins where others do, and ends where it is looked at again
SLIP_STARTS = (0.9, 0.7, 0.5)  # initial guesses of mu over the largest friction that rolling needs


Path = tuple[Array, Array]  # q and qdot of the disc at the instants of each camera, both (2, n, 6)
Point = tuple[Sight, dict[str, Array]]  # at one point of a fit: the dots, and derivatives (n, 4 m) that were computed


class DiscSystem(System):
    """Dots of a rolling disc in two cameras; samples are frames, a row holds the whitened coordinates of all dots."""

    frees_shapes = True

    def __init__(
        self,
        trajectory: Trajectory,
        model: Model,
        candidates: tuple[Candidate, ...] | None = None,
        *,
        rows: slice | None = None,
        systematic: Systematic | None = None,
        slips: bool = False,
        known: Values | None = None,
    ) -> None:
        """Model : declared disc, gravity and effects; the parameters of its effects are fitted in every fit.

        candidates : by default all effects and faults of the catalogues
        rows : frames that are used; by default those of `free_stretch`
        slips : the disc slips at first: every fit moves the quantities of `slip_start`
        known : faults of the measurement that are held at these values; tolerances are about them
        systematic : prior standard deviations of the random fields that are fitted as nuisances
        Raises AnalysisError.
        """
        self.systematic = systematic or Systematic()
        self.known = dict(known or {})
        self.measured: Path | None = None  # replaces the model of the motion
        self.notes: tuple[str, ...] = ()  # on frames that were left out
        if rows is None:
            rows, self.notes = free_stretch(trajectory)
        self.model = model
        self.trajectory = trajectory
        self.rig, self.disc = trajectory.rig, trajectory.disc
        self.faults = faults_of(self.disc)
        self.rows = rows
        self.time = np.asarray(trajectory.time[rows], float)
        self.start_time = float(self.time[0])
        self.used = trajectory.marker_status[rows] == MarkerStatus.MEASURED
        self.used &= np.isfinite(trajectory.markers_px[rows]).all(-1)
        self.used &= np.isfinite(trajectory.markers_covariance_px2[rows]).all((-1, -2))
        self.observed = np.where(self.used[..., None], trajectory.markers_px[rows], 0.0)  # (n, 2, m, 2) [px]
        safe = np.where(self.used[..., None, None], trajectory.markers_covariance_px2[rows], np.eye(2))
        self._whiten = np.where(self.used[..., None, None], whitening(safe), 0.0)
        self.weights = np.asarray(2.0 * self.used.sum((1, 2)), float)
        self.trial_work = TRIAL_WORK * len(self.time)
        self.budget = Budget(MOST_WORK * max(len(self.time), USUAL))
        if candidates is None:
            candidates = (*motion.motion_candidates(model), *motion.measurement_candidates(self.disc))
        self.slips, of_slip = slips, motion.slip_start(model).quantities if slips else ()
        fitted = (*motion.state_quantities(), *motion.model_quantities(model), *of_slip)
        sizes = tuple(self._sizes({q.name for q in fitted}))
        # a table determined from the rim has its own plane in each recording, which is no fault
        in_base = {q.name for q in (*of_slip, *(q for q in sizes if not q.belongs_to))}
        self.candidates = tuple(c for c in candidates if not in_base & set(c.names))
        nuisances, self._nuisance_columns = self._nuisances()
        self._nuisance_names = dict.fromkeys(q.name for q in nuisances)
        self.base = (*fitted, *sizes, *nuisances)
        self._absent = {q.name: q.null for c in self.candidates for q in c.quantities}
        self._points: dict[frozenset[tuple[str, float]], Point] = {}
        self.remembers = max(2, REMEMBERED * USUAL // max(len(self.time), 1))  # points

    def _sizes(self, fitted: Set[str]) -> Iterator[Quantity]:
        """Errors of the disc's sizes and of the table, with their tolerances as priors; an effect exceeds these.

        Without those that are `fitted` anyway. The uncertainty of the table's plane is in the covariance of the rig,
        except for the amount by which tracking moved it: locally, a hollow is a slope and a height.
        """
        radius = MICROMETER if self.disc.radius_tolerance is None else self.disc.radius_tolerance
        half = 0.5 * thickness_tolerance(self.disc)
        sizes = {"contact_radius.r_error": radius, "contact_height.h_error": half, "pattern_height.offset": half}
        height, slope_x, slope_y = self.trajectory.table_moved
        sizes |= {"table_height.offset": height, "table_plane.tilt_x": slope_y, "table_plane.tilt_y": slope_x}
        of_motion = motion.motion_candidates(self.model, ("contact_radius", "contact_height"))
        of_table = ("table_height", "table_plane")
        faults = motion.measurement_candidates(self.disc, ("pattern_height", *of_table))
        for candidate in (*of_motion, *faults):
            for q in candidate.quantities:
                sigma, most = sizes[q.name], MOST_SIGMAS * sizes[q.name]
                owner = () if candidate.name in of_table else q.belongs_to
                if q.name not in fitted and sigma > 0:
                    middle = self.known.get(q.name, q.null)
                    lower, upper = max(q.lower, middle - most), min(q.upper, middle + most)
                    yield replace(q, null=middle, prior_sigma=sigma, lower=lower, upper=upper, belongs_to=owner)

    def _nuisances(self) -> tuple[tuple[Quantity, ...], Array]:
        """Nuisance parameters common to all frames, with priors, and their whitened columns (n, 4 m, k).

        They are so small that columns at the measured poses are used for every prediction. Directions of the
        calibration's covariance are in units of their standard deviation.
        """
        q, _ = self._as_measured(scene_faults(self.disc, self.known).right_delay_s)
        R, n = rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0)), len(self.time)
        points = self.disc.marker_centres_body @ np.swapaxes(R, -1, -2) + q[..., None, :3]
        seen = self.rig.project_with_jacobians(points)
        places, by_point, by_rig = (np.stack([x[0, :, 0], x[1, :, 1]], axis=1) for x in seen)
        rig = self.whitened(by_rig) @ square_root(self.rig.covariance)
        _, singular, V = np.linalg.svd(triangle(rig.reshape(-1, rig.shape[-1])))
        shown = V[singular > MIN_NUISANCE]
        rig = rig @ shown.T @ shown  # the same parameters in all recordings of the rig
        along = np.einsum("ncmap,cnpb->ncmab", by_point, R[..., :2])  # by the dots' positions on the face
        m, sizes = self.disc.n_markers, self.systematic
        dots = (self._whiten @ along)[:, :, :, :, None, :] * np.eye(m)[None, None, :, None, :, None]
        sigma, bias = float(np.hypot(DOT_SIGMA, sizes.print_m)), "bias common to all images of a dot"
        one = Quantity("dot", "m", 1e-8, prior_sigma=sigma, meaning=bias, linear=True, belongs_to=("disc",))
        quantities = _nuisances("rig", rig.shape[-1], "direction of the calibration's covariance", ("rig",))
        quantities += [replace(one, name=f"dot_{i}.{axis}") for i in range(m) for axis in "xy"]
        columns = [rig, dots.reshape(n, -1, 2 * m)]
        together = sizes.lens_places  # of all recordings of the rig
        for name, size, length, own, meaning, of_rig in (
            ("lens_field", sizes.lens_px, sizes.lens_length_px, False, "mode of the lenses' residual fields", together),
            ("dot_field", sizes.dot_px, sizes.dot_length_px, True, "mode of the dots' own residual fields", ()),
        ):
            if size > 0:
                # for several recordings, all modes that a field of ten sigmas of a single dot determines
                sigmas = 10.0 if of_rig else size * self.per_px
                shifts = size * field_columns(places, self.used, length, sigmas, own, of_rig)
                columns.append(self.whitened(shifts))
                quantities += _nuisances(name, shifts.shape[-1], meaning, ("rig",) if of_rig else ())
        return tuple(quantities), np.concatenate(columns, axis=-1)

    def whitened(self, shifts: Array) -> Array:
        """(n, 4 m, k) of shifts of the dots (n, 2, m, 2, k) [px]; k may be 0."""
        found = self._whiten @ shifts
        return np.asarray(found.reshape(len(found), 2 * self.used[0].size, shifts.shape[-1]), float)

    def _as_measured(self, delay: float) -> Path:
        """The measured motion, by a cubic spline through the poses, which interpolates rows without a pose."""
        q = self.trajectory.q[self.rows]
        known = np.isfinite(q).all(axis=1)
        course = CubicSpline(self.time[known], q[known])
        times = np.stack([self.time, self.time + delay])
        return course(times), course(times, 1)

    def about_poses(self, known: Values) -> "DiscSystem":
        """The same dots about the measured poses, which replace the model of the motion.

        known : faults with which the poses were fitted
        """
        delay = scene_faults(self.disc, known).right_delay_s
        met = self.time + delay  # by the right camera
        weights = np.where((met >= self.time[0]) & (met <= self.time[-1]), self.weights, 0.0)
        return self._with(measured=self._as_measured(delay), weights=weights)

    def start(self) -> dict[str, float]:
        """Initial guess of the base quantities from the measured poses, with the known faults."""
        return start_values(self)

    def again(self, candidates: tuple[Candidate, ...] | None = None, **other: Any) -> "DiscSystem":
        """A system of the same recording and model, with the same budget; rows, fields and known faults as here.

        Candidates and `slips` are the defaults if not given.
        """
        same = {"rows": self.rows, "systematic": self.systematic, "known": self.known}
        system = DiscSystem(self.trajectory, self.model, candidates, **{**same, **other})
        system.budget, system.notes = self.budget, self.notes
        return system

    def beginnings(self) -> "Iterator[DiscSystem]":
        """First parts of increasing length, for fits that do not converge for the whole recording."""
        for stretch in STRETCHES:
            n = int(np.searchsorted(self.time, self.time[0] + stretch, side="right"))
            if n < len(self.time):
                cut = ("time", "used", "observed", "_whiten", "weights", "_nuisance_columns")
                rows = slice(self.rows.start, self.rows.start + n)
                yield self._with(rows=rows, **{name: getattr(self, name)[:n] for name in cut})

    @property
    def per_px(self) -> float:
        """One pixel in units of the standard deviation of a dot, rms."""
        return float(np.sqrt(np.mean(self._whiten[self.used] ** 2) * 2)) if self.used.any() else 1.0

    @property
    def rate(self) -> float:
        """Of the frames [Hz]."""
        return float(1.0 / np.median(np.diff(self.time)))

    def knowing(self, law: LearnedLaw) -> "DiscSystem":
        """The same system with this law in its model: its coefficients may be among the values."""
        return self._with(model=self.model.knowing(law.effect))

    def _with(self, **changed: object) -> "DiscSystem":
        """A copy with other attributes, which remembers nothing."""
        other = copy(self)
        other.__dict__ |= changed | {"_points": {}}
        return other

    def model_with(self, values: Values) -> Model:
        """The model with every effect that has an amount in `values`."""
        effects = {name: v for name, v in values.items() if self.model.has_name(name)}
        if values.get(motion.SLIP, 0.0) > 0:
            effects["slip.mu"] = 1.0 / values[motion.SLIP]
        return self.model.with_values(effects)

    def starts(self, candidate: Candidate, values: Values, least: float = 0.0) -> Sequence[tuple[float, ...]]:
        """For slip: the coefficient nearest to the data, of some with which the disc would slip seldom to mostly.

        For others: initial guesses of the shape, if it needs any.
        """
        if not candidate.threshold:
            return shape_guesses(self, candidate, values, least)
        rolled = simulate(self.model_with(values), motion.state_of(values), times=self.instants(values))
        tried = 1.0 / (np.array(SLIP_STARTS) * np.max(rolled.friction_needed))
        chi_squares = [np.sum(self.linearise({**values, motion.SLIP: inverse}, [])[0] ** 2) for inverse in tried]
        return [(float(tried[np.argmin(np.nan_to_num(chi_squares, nan=np.inf))]),)]

    def instants(self, values: Values) -> Array:
        """(n,) true instants of the frames of the left camera [s]."""
        return self.start_time + scene_faults(self.disc, values).true_times(self.time - self.start_time, 1.0)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened dots (n, 4 m), observed minus predicted, and the prediction's derivative (n, 4 m, k)."""
        sight, known = self._point(values)
        new = [n for n in names if n not in known]
        self.budget.work(len(new) * len(self.time))
        columns = known | (self._columns(sight, values, new) if new else {})
        # the steps of one call may be used up before its last derivatives, which another call computes
        known |= {n: columns[n] for n in new if np.isfinite(columns[n]).all()}
        derivative = np.zeros((len(self.time), 2 * self.used[0].size, len(names)))
        for i, name in enumerate(names):
            derivative[..., i] = columns[name]
        return self._residual(sight.pixels, values), derivative

    def _columns(self, sight: Sight, values: Values, names: Sequence[str]) -> dict[str, Array]:
        """Derivatives (n, 4 m) by these names; zero for those that move nothing."""
        found = dict.fromkeys(names, np.zeros((len(self.time), 2 * self.used[0].size)))
        _, moved, by_motion = self._path(values, names)
        found |= zip(moved, np.moveaxis(self.whitened(sight.by_pose) @ by_motion, -1, 0), strict=True)
        for fault in self.faults:
            for name, part in zip(fault.names(), fault.parts, strict=True):
                if name in found:
                    found[name] = self.whitened(fault.column(part, sight)[..., None])[..., 0]
        return found

    def _point(self, values: Values) -> Point:
        """What is known at these values; nuisances, and effects that are absent, do not matter."""
        moved = ((n, v) for n, v in values.items() if n not in self._nuisance_names and v != self._absent.get(n))
        known = self._points.pop(key := frozenset(moved), None)
        if known is None:
            nuisances = zip(self._nuisance_names, np.moveaxis(self._nuisance_columns, -1, 0), strict=True)
            known = self._sight(self._path(values)[0], values), dict(nuisances)
        self._points[key] = known  # the last one
        if len(self._points) > self.remembers:
            del self._points[next(iter(self._points))]
        return known

    def pixels(self, values: Values) -> Array:
        """Predicted images of the dots (n, 2, m, 2) [px], without the nuisances."""
        return self._point(values)[0].pixels

    def residual_px(self, values: Values) -> Array:
        """Residuals of the images of the dots (n, 2, m, 2) [px]; zero where a dot is not used."""
        whiten = np.where(self.used[..., None, None], self._whiten, np.eye(2))
        residual = self.linearise(values, [])[0].reshape(*self.observed.shape, 1)
        return np.asarray(np.linalg.solve(whiten, residual)[..., 0], float)

    def poses(self, values: Values) -> Array:
        """Predicted coordinates q (n, 6) at the instants of the left camera, in axes of the true table."""
        (q, _), *_ = self._path(values)
        return q[0]

    def pose_residual(self, values: Values) -> Array:
        """(n, 6) part of the whitened residual that a free pose per frame absorbs, of variance 1."""
        return self.parts_of_residual(values)[0]

    def coordinate_errors(self, values: Values) -> tuple[Array, Array]:
        """Measured minus predicted coordinates and their standard deviations, both (n, 6); NaN without dots.

        By one Gauss-Newton step of a free pose, with the cameras and the pattern at `values`.
        """
        r, J, normal = self.pose_equations(values)
        to_coordinates = np.tile(np.eye(6), (len(r), 1, 1))
        to_coordinates[:, 3:, 3:] = euler_jacobian(*self.poses(values)[:, 3:5].T)
        covariance = np.linalg.inv(normal)
        delta = (to_coordinates @ covariance @ (np.swapaxes(J, 1, 2) @ r[..., None]))[..., 0]
        variance = np.diagonal(covariance, axis1=1, axis2=2)[..., None]
        sigma = np.sqrt((to_coordinates**2 @ variance)[..., 0])
        known = (self.weights >= 6)[:, None]
        return np.where(known, delta, np.nan), np.where(known, sigma, np.nan)

    def parts_of_residual(self, values: Values) -> tuple[Array, Array]:
        """The part (n, 6) of the whitened residual that a free pose per frame absorbs, and the rest (n, 4 m)."""
        r, J, normal = self.pose_equations(values)
        gradient = np.swapaxes(J, 1, 2) @ r[..., None]
        pose = np.linalg.solve(np.linalg.cholesky(normal), gradient)[..., 0]
        return pose, r - (J @ np.linalg.solve(normal, gradient))[..., 0]

    def together(self, values: Values, width: int) -> Array:
        """Directions (n, 4 m, 12) of the dots by a motion of the disc in one camera: vibration, or clock jitter."""
        moved = self.pose_equations(values)[1].reshape(len(self.time), 2, width // 2, 6)
        enough = (self.used.sum(axis=-1) > 3)[..., None, None]
        moved = np.where(enough, moved, 0.0)
        root = np.linalg.cholesky(np.where(enough, np.swapaxes(moved, -1, -2) @ moved, np.eye(6)))
        own = np.swapaxes(np.linalg.solve(root, np.swapaxes(moved, -1, -2)), -1, -2)
        found = np.zeros((len(moved), 2, width // 2, 2, 6))
        found[:, 0, :, 0], found[:, 1, :, 1] = own[:, 0], own[:, 1]
        return found.reshape(len(moved), width, 12)

    def pose_equations(self, values: Values) -> tuple[Array, Array, Array]:
        """Residual (n, 4 m), its derivative (n, 4 m, 6) and normal matrix (n, 6, 6) by a free pose per frame."""
        sight, _ = self._point(values)
        r = self._residual(sight.pixels, values)
        J = self.whitened(sight.by_pose)
        normal = np.swapaxes(J, 1, 2) @ J
        normal[self.weights < 6] = np.eye(6)
        return r, J, normal

    def _residual(self, pixels: Array, values: Values) -> Array:
        """Whitened rows of observed minus predicted dots, minus the contribution of the nuisances."""
        residual = self.whitened((self.observed - pixels)[..., None])[..., 0]
        weights = np.array([values.get(name, 0.0) for name in self._nuisance_names])
        return residual - self._nuisance_columns @ weights if weights.any() else residual

    def _path(self, values: Values, names: Sequence[str] = ()) -> tuple[Path, tuple[str, ...], Array]:
        """Motion at the true instants of both cameras, the names on which it depends, and its derivatives by these.

        The derivatives (n, 6, k) are of pose components, of the rotation as a rotation vector.
        """
        still = np.zeros((len(self.time), 6, 0))
        if self.measured is not None:
            return self.measured, (), still
        times, delay = self.instants(values), scene_faults(self.disc, values).right_delay_s
        model, state = self.model_with({k: v for k, v in values.items() if np.isfinite(v)}), motion.state_of(values)
        # a step of the fit may lead to states in which no disc rolls, or whose integration does not end
        fastest = 3 * np.sqrt(4 * model.gravity / (self.disc.radius * np.sin(motion.THETA_END)))
        nowhere = not motion.THETA_END < state.theta <= np.pi / 2 or max(abs(state.psidot), abs(state.omega3)) > fastest
        if nowhere or (self.slips and model.effect("slip") is None):  # 1/mu = 0: no velocity is free
            nothing = np.full((2, len(times), 6), np.nan)
            return (nothing, nothing), (), still
        components = [n for n in names if n.startswith("state.")]
        parameters = {n: n for n in names if model.has_name(n) and np.isfinite(values.get(n, 0.0))}
        if motion.SLIP in names and values.get(motion.SLIP, 0.0) > 0:
            parameters[motion.SLIP] = "slip.mu"
        limit = int(MAX_SWITCHES[0] + MAX_SWITCHES[1] * (times[-1] - times[0]))
        rolls = model.effect("slip") is None and model.effect("creep") is None
        # a motion that needs more steps is given up
        left = int(min(self.budget.trial_left, self.trial_work * (ROLLS if rolls else 1.0)))
        of_state = [n.partition(".")[2] for n in components]
        # steps of a fit and scores need derivatives to 1e-6 only: to 1e-8 they take four fifths of the steps
        effort = Effort(RTOL, limit, left, rtol_of_derivatives=10 * RTOL)
        moving = sensitivities(model, state, times, tuple(parameters.values()), of_state, motion.THETA_END, effort)
        self.budget.work(moving.n_steps)
        by_motion, moved = moving.dq.copy(), (*components, *parameters)
        by_motion[:, 3:] = euler_rate_axes_world(moving.q[:, 3], moving.q[:, 4]) @ moving.dq[:, 3:]
        if motion.SLIP in parameters:
            by_motion[..., moved.index(motion.SLIP)] *= -1.0 / values[motion.SLIP] ** 2
        q, qdot = np.stack([moving.q] * 2), np.stack([moving.qdot] * 2)
        if delay and np.isfinite(moving.q).all():
            spline = CubicHermiteSpline(times, moving.q, moving.qdot)
            q[1], qdot[1] = spline(times + delay), spline(times + delay, 1)
        return (q, qdot), moved, by_motion

    def _sight(self, path: Path, values: Values) -> Sight:
        """The dots in both cameras along this path."""
        q, speed = path[0], path[1].copy()
        speed[..., 3:] = (euler_rate_axes_world(q[..., 3], q[..., 4]) @ speed[..., 3:, None])[..., 0]
        R, t = rotation_from_euler(q[..., 3], q[..., 4], q[..., 5]), q[..., :3]
        images = predict(R, t, self.rig, self.disc, scene_faults(self.disc, values))
        sight = Sight(self.time, R, t, speed, self.rig, self.disc, values, *images)
        for fault in self.faults:
            if fault.in_images and (v := fault.numbers(values)).any():
                shift = sum(x * fault.column(part, sight) for x, part in zip(v, fault.parts, strict=True))
                sight = replace(sight, pixels=sight.pixels + shift)
        return sight


def _nuisances(name: str, k: int, meaning: str, belongs_to: tuple[str, ...] = ()) -> list[Quantity]:
    """Linear quantities in units of their standard deviation."""
    one = Quantity(name, "sigma", 0.1, prior_sigma=1.0, meaning=meaning, linear=True, belongs_to=belongs_to)
    return [replace(one, name=f"{name}.{i}") for i in range(k)]
