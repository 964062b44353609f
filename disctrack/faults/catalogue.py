"""Catalogue of the faults: quantities, keys in a scene, and descriptions.

`key` is the key of the fault in a scene's `Faults`. If the numbers differ from its value by more than a factor,
`to_key` and `from_key` convert them. `along` computes the effect on the dots if differences are not suitable.
Candidates of the diagnosis, scenes, saved models, planted faults and the page of faults are built from these entries.

Quantities are addressed by name, like parameters of the effects of the motion: "right_turned.rotation_x". Null is
always zero: as calibrated, as declared.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from operator import attrgetter
from typing import Any

import numpy as np

from calibration.kit.types import Array
from disctrack.disc import Disc
from disctrack.faults.dots import Sight, ellipse_centre_shift, predict
from disctrack.faults.keys import Faults
from disctrack.findings import Kind
from disctrack.frames import CAMERAS

MOVED = (Kind.CAMERA_MOVED, Kind.DOTS_MISFIT, Kind.CAMERAS_CONTRADICT, Kind.TABLE_DISAGREES)
HEIGHT = (Kind.TABLE_DISAGREES, Kind.THICKNESS, Kind.BOARD_THICKNESS)
TYPICAL_STEPS = 30  # size of an ordinary fault: 1/3 px, 0.02 deg, 0.3 mm, 0.3 ms


@dataclass(frozen=True)
class Fault:
    """One possible fault of the measurement."""

    name: str
    title: str  # a sentence
    source: str  # its cause
    parts: tuple[str, ...]  # names of its numbers
    unit: str
    step: float  # in fits: about a hundredth of a pixel in the image
    meaning: str
    key: str  # of a scene's `Faults`, in the unit of its name: "table_height_mm", "left.rotation_deg"
    null: float = 0.0
    bounds: tuple[float, float] = (-np.inf, np.inf)  # range in any laboratory
    belongs_to: tuple[str, ...] = ("rig",)  # what recordings that share it have in common
    in_images: bool = False  # its number times `column` is added to the images of the dots
    of_poses_alone: bool = True  # is visible in the dots of free poses, without a model of the motion
    along: Callable[["Fault", str, Sight], Array] | None = None  # the column of a part; None: by differences
    to_key: Callable[[Array, Any, float], Any] | None = None  # numbers, old value, declared rate [Hz] -> value of key
    from_key: Callable[[Any, float], Any] | None = None
    each: str = ""  # "camera": a fault of each camera; "dot": of each dot, inserted in the title
    seen: str = ""  # symptom for the user
    remedy: str = ""
    declared: str = ""  # the key of recording.toml whose wrong value has the same effect
    named_by: tuple[Kind, ...] = ()  # findings of a run that report it; empty if a run cannot detect it

    @property
    def factor(self) -> float:
        """(Value of the scene's key - null) over the number."""
        return {"deg": float(np.degrees(1.0)), "mm": 1e3}.get(self.key.rpartition("_")[2], 1.0)

    def names(self) -> tuple[str, ...]:
        """Names of its quantities."""
        return tuple(f"{self.name}.{part}" for part in self.parts)

    def numbers(self, values: Mapping[str, float]) -> Array:
        """Its numbers among the values, by default zero."""
        return np.array([float(values.get(name, 0.0)) for name in self.names()])

    def column(self, part: str, sight: Sight) -> Array:
        """Derivative (n, 2, m, 2) of the images of the dots with respect to one of its numbers.

        By central differences, with a relative error of 1e-8, as the images are smooth and nearly linear in it.
        """
        if self.along is not None:
            return self.along(self, part, sight)
        name, sides = f"{self.name}.{part}", []
        for sign in (1.0, -1.0):
            changed = dict(sight.values) | {name: sight.values.get(name, 0.0) + sign * self.step}
            sides.append(_images(sight, scene_faults(sight.disc, changed)))
        return (sides[0] - sides[1]) / (2 * self.step)

    def to_scene(self, faults: Faults, v: Array, rate: float) -> Faults:
        """Faults of a scene with these numbers; rate : declared [Hz]."""
        camera, _, key = self.key.rpartition(".")
        place: Any = getattr(faults, camera) if camera else faults
        if self.to_key is not None:
            value = self.to_key(v, getattr(place, key), rate)
        else:
            numbers = tuple(float(self.null + self.factor * x) for x in v)
            value = numbers if len(numbers) > 1 else numbers[0]
        place = replace(place, **{key: value})
        return replace(faults, **{camera: place}) if camera else place

    def from_scene(self, faults: Faults, rate: float) -> Array:
        """Inverse of `to_scene`."""
        value = attrgetter(self.key)(faults)
        if self.from_key is not None:
            return np.atleast_1d(np.asarray(self.from_key(value, rate), float))
        return np.asarray((np.atleast_1d(value) - self.null) / self.factor, float)


def _images(sight: Sight, faults: Faults) -> Array:
    """Images of the dots with these faults; the motion until the true instant of an exposure is linearised."""
    since = sight.time - sight.time[0]
    late = faults.true_times(since, 1.0) - since
    by_camera = np.stack([late, late + faults.right_delay_s])
    moved: Array = np.einsum("ncmap,cnp,cn->ncma", sight.by_pose, sight.speed, by_camera)
    return predict(sight.R, sight.t, sight.rig, sight.disc, faults)[0] + moved


def _of_one_dot(fault: Fault, part: str, sight: Sight) -> Array:
    moved, dot = np.zeros_like(sight.pixels), int(fault.name.partition("_")[2])
    along = sight.R[:, :, :, fault.parts.index(part)]  # (2, n, 3) body axis in the world
    moved[:, :, dot] = np.einsum("ncap,cnp->nca", sight.by_pose[:, :, dot, :, :3], along)
    return moved


def _blurred(fault: Fault, part: str, sight: Sight) -> Array:
    """Second time derivative of the images of the dots over 24, by differences of neighbouring frames."""
    twice = np.gradient(np.gradient(sight.pixels, sight.time, axis=0), sight.time, axis=0)
    return np.asarray(twice, float) / 24


def _with_row(dot: int, n: int, v: Array, rows: tuple[Any, ...], rate: float) -> tuple[Any, ...]:
    """Rows of a scene for n dots, or no rows, with the row of one dot replaced."""
    places = list(rows or [(0.0, 0.0)] * n)
    places[dot] = tuple(float(1e3 * x) for x in v)
    return tuple(places)


def _row(dot: int, rows: tuple[Any, ...], rate: float) -> tuple[float, ...]:
    return tuple(1e-3 * x for x in rows[dot]) if rows else (0.0, 0.0)


_KNOCK = "mount, cable, knock"
_of_camera = partial(
    Fault, each="camera", seen="the cameras contradict each other on the same dots, throughout",
    remedy="calibrate again where you record", named_by=MOVED,
)  # fmt: skip
FAULTS = (
    Fault("time_offset", "the right camera exposes later than the left", "synchronisation of the cameras",
          ("delay",), "s", 1e-5, "right minus left", "right_delay_s", bounds=(-0.05, 0.05),
          seen="the dots of the two cameras contradict each other, the more the faster the disc is",
          remedy="check the trigger; renumber the images of the camera that is ahead by whole frames",
          named_by=(Kind.DELAY, Kind.DROPPED_FRAMES)),
    Fault("frame_rate", "the true frame rate differs from the declared one", "clock of the cameras",
          ("change",), "1", 1e-4, "true over declared minus one", "frame_rate_hz", bounds=(-0.6, 1.2),
          of_poses_alone=False,
          to_key=lambda v, _, rate: float(rate * (1.0 + v[0])) if v[0] else 0.0,
          from_key=lambda x, rate: x / rate - 1.0 if x else 0.0,
          seen="the balance of moments gives another gravity: g goes as the square of the rate",
          remedy="declare the rate that the camera's software states", declared="[cameras] frame_rate_hz",
          named_by=(Kind.GRAVITY_OR_RATE,)),
    Fault("clock_drift", "the clock of the cameras changes its rate", "oscillator that warms, trigger that slows down",
          ("growth",), "1/s", 1e-4, "of the time between frames, relative, per second", "frame_interval_growth",
          bounds=(-0.5, 0.5), of_poses_alone=False, seen="gravity seems to change slowly",
          remedy="trigger by a quartz; let the cameras warm up"),
    _of_camera("turned", "the {} camera turned after its calibration", _KNOCK,
               ("rotation_x", "rotation_y", "rotation_z"), "rad", 1e-5, "in its own axes", "rotation_deg",
               bounds=(-0.06, 0.06)),
    _of_camera("shifted", "the {} camera moved after its calibration", _KNOCK,
               ("translation_x", "translation_y", "translation_z"), "m", 1e-5, "in its own axes", "translation_mm",
               bounds=(-0.01, 0.01)),
    _of_camera("focal", "the focal length of the {} camera changed", "focus, temperature", ("change",), "1", 1e-5,
               "relative", "focal_scale", null=1.0, bounds=(-0.05, 0.05)),
    _of_camera("principal_point", "the principal point of the {} camera moved", "lens not fixed", ("x", "y"), "px",
               0.01, "in the image", "principal_point_change_px", bounds=(-5.0, 5.0)),
    _of_camera("distortion", "the distortion of the {} camera changed", "focus, aperture, other lens", ("k1",), "1",
               1e-3, "change of Brown's k1", "k1_change", bounds=(-1.0, 1.0)),
    Fault("misprint", "dot {} is not where it was declared", "printing", ("x", "y"), "m", 1e-6, "body axes",
          "misprint_mm", belongs_to=("disc",), along=_of_one_dot, each="dot",
          seen="one dot misses its place in every frame", remedy="measure it on the sheet",
          declared="[markers] centres_mm", named_by=(Kind.DOTS_MISPLACED, Kind.DOT_UNSEEN)),
    Fault("pattern_offset", "the dots as a whole are off the disc's centre", "gluing of the paper", ("x", "y"), "m",
          1e-6, "body axes", "pattern_offset_mm", belongs_to=("disc",),
          seen="the centre circles about another point once a turn of the spin",
          remedy="centre the sheet, or measure by how much it is off", declared="[markers] centres_mm",
          named_by=(Kind.DOTS_MISPLACED, Kind.TABLE_DISAGREES)),
    Fault("pattern_rotation", "the dots as a whole are turned on the face",
          "gluing; the same as another spin angle", ("angle",), "rad", 1e-5, "about e3", "pattern_turn_deg",
          belongs_to=("disc",), seen="nothing: it is where phi is counted from"),
    Fault("pattern_scale", "the dots as a whole are printed too large", "printer", ("change",), "1", 1e-5, "relative",
          "pattern_scale", null=1.0, belongs_to=("disc",),
          seen="dots and chessboard contradict each other in their scale",
          remedy="measure the printed sheet with a caliper", declared="[markers] centres_mm",
          named_by=(Kind.SQUARE, Kind.DOTS_MISPLACED)),
    Fault("pattern_height", "the dots lie higher than half the thickness", "paper, glue, thickness", ("offset",), "m",
          1e-6, "along e3", "pattern_height_mm", belongs_to=("disc",),
          seen="the disc's lowest point lies off the table",
          remedy="measure the thickness with its paper", declared="[disc] thickness_mm", named_by=HEIGHT),
    Fault("table_plane", "the table is not parallel to the calibration's table view", "board on a burr",
          ("tilt_x", "tilt_y"), "rad", 1e-5, "turn of the true table, calibrated axes", "table_turn_deg",
          seen="the disc's lowest point rises towards one side",
          remedy="lay the board flat, and take the table view again", declared="[table] view",
          named_by=(Kind.TABLE_VIEW, *HEIGHT)),
    Fault("table_height", "the table is not where the calibration's table view says", "thickness of the board",
          ("offset",), "m", 1e-6, "true height of the table in the calibrated axes", "table_height_mm",
          seen="the disc's lowest point lies off the table", remedy="measure the board's thickness",
          declared="[table] board_thickness_mm", named_by=HEIGHT),
    Fault("exposure_blur", "dots are averaged over an exposure", "centre moves by T^2/24 times its acceleration",
          ("T2",), "s^2", 1e-7, "square of the exposure", "exposure_s", bounds=(0.0, 1e-3), in_images=True,
          of_poses_alone=False, along=_blurred, to_key=lambda v, *_: float(np.sqrt(max(v[0], 0.0))),
          from_key=lambda x, _: x**2, seen="dots smeared along their way, nutation too small",
          remedy="declare the exposure, or expose for a shorter time", declared="[cameras] exposure_us",
          named_by=(Kind.EXPOSURE,)),
    Fault("ellipse_centre", "centres of ellipses were taken for images of the centres", "perspective of circles",
          ("share",), "1", 0.1, "1: not corrected at all, -1: corrected twice", "ellipse_centre_share",
          bounds=(-2.0, 2.0), in_images=True,
          along=lambda _, part, sight: ellipse_centre_shift(sight.R[0], sight.t[0], sight.rig, sight.disc),
          seen="dots of another program lie off", remedy="correct its centres, or measure with disctrack"),
)  # fmt: skip


def faults_of(disc: Disc) -> tuple[Fault, ...]:
    """All faults of the catalogue for a measurement of this disc."""
    return _faults_of(disc.n_markers)


@cache
def _faults_of(n_markers: int) -> tuple[Fault, ...]:
    return tuple(one for fault in FAULTS for one in each_of(fault, n_markers))


def each_of(fault: Fault, n_markers: int) -> Iterator[Fault]:
    """A fault of a camera or a dot for each of these; other faults unchanged."""
    if fault.each == "camera":
        for camera in CAMERAS:
            name, title, key = f"{camera}_{fault.name}", fault.title.format(camera), f"{camera}.{fault.key}"
            yield replace(fault, name=name, title=title, key=key)
    elif fault.each == "dot":
        for i in range(n_markers):
            one = replace(fault, name=f"{fault.name}_{i}", title=fault.title.format(i))
            yield replace(one, to_key=partial(_with_row, i, n_markers), from_key=partial(_row, i))
    else:
        yield fault


def scene_faults(disc: Disc, values: Mapping[str, float], rate: float = 1.0) -> Faults:
    """Faults of a scene with this disc, this declared frame rate [Hz] and these values, which are null by default."""
    found = Faults()
    for fault in faults_of(disc):
        v = fault.numbers(values)
        if v.any():
            found = fault.to_scene(found, v, rate)
    return found


def values_in_scene(disc: Disc, faults: Faults, rate: float) -> dict[str, float]:
    """Inverse of `scene_faults`: the values that are not null."""
    found: dict[str, float] = {}
    for fault in faults_of(disc):
        found |= zip(fault.names(), map(float, fault.from_scene(faults, rate)), strict=True)
    return {name: value for name, value in found.items() if value}
