"""What may be wrong about a measurement: clocks, cameras, dots, table. One entry, or class, for each kind of fault.

To add one, write a `Keyed` here: its quantities, what it alters (`MeasurementSetup`), and its place in a scene
(scene.description.Faults), so that it can be rendered, saved and given to the next diagnosis. One that does more than
write its numbers there is a class. Candidates, prediction, derivatives, models and trials take it from `faults_of`.

Quantities are addressed by name, as parameters of the effects of the motion are: "right_turned.rotation_x". Null is
always zero: as calibrated, as declared.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.cameras.camera import Camera, StereoRig, project_with_jacobians
from calibration.kit.arrays import Array
from disctrack.disc import Disc
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.frames import CAMERAS, rotation_from_vector
from disctrack.synthetic.description import Faults, Scene

TYPICAL_STEPS = 30  # a fault of so many steps surprises nobody: 1/3 px, 0.02 deg, 0.3 mm, 0.3 ms
RIM_POINTS = 24  # of a dot's outline, for the centre of its image


@dataclass
class CameraChange:
    """What became of one camera after its calibration."""

    rotation: Array = field(default_factory=lambda: np.zeros(3))  # [rad] vector in its own axes
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [m] in its own axes
    focal: float = 0.0  # relative
    centre: Array = field(default_factory=lambda: np.zeros(2))  # [px] of the principal point
    k1: float = 0.0

    def lens(self, camera: Camera) -> Camera:
        """The camera with its lens as it is now."""
        k1, k2, p1, p2, k3 = camera.distortion
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + float(self.centre[0]),
            cy=camera.cy + float(self.centre[1]),
            distortion=(k1 + self.k1, k2, p1, p2, k3),
        )


@dataclass
class MeasurementSetup:
    """How clocks, cameras, dots and table differ from what was declared and calibrated. Faults alter it."""

    misprint: Array  # (m, 2) [m] of single dots, body axes
    rate: float = 1.0  # true over declared frame rate
    delay: float = 0.0  # [s] of the right camera
    cameras: tuple[CameraChange, CameraChange] = field(default_factory=lambda: (CameraChange(), CameraChange()))
    pattern_offset: Array = field(default_factory=lambda: np.zeros(3))  # [m] body axes
    pattern_turn: float = 0.0  # [rad] about e3
    pattern_growth: float = 0.0  # relative
    table_turn: Array = field(default_factory=lambda: np.zeros(3))  # [rad] of the true table in calibrated axes
    table_height: float = 0.0  # [m]

    def centres(self, disc: Disc) -> Array:
        """(m, 3) where the dots are on the body [m]."""
        centres = disc.marker_centres_body.copy()
        centres[:, :2] += self.misprint
        c, s = np.cos(self.pattern_turn), np.sin(self.pattern_turn)
        centres[:, :2] = (1.0 + self.pattern_growth) * centres[:, :2] @ np.array([[c, s], [-s, c]])
        return np.asarray(centres + self.pattern_offset)


@dataclass(frozen=True)
class DotImages:
    """Predicted images of the dots and how they move with the pose."""

    pixels: Array  # (n, 2, m, 2)
    by_pose: Array  # (n, 2, m, 2, 6), POSE_COMPONENTS of the disc in the world


@dataclass(frozen=True)
class Sight:
    """Dots of a moving disc as both cameras meet them: what a fault needs to tell what it does to them."""

    time: Array  # (n,) [s] of the frames, by the declared clock
    R: Array  # (2, n, 3, 3), t (2, n, 3) body -> world, at the instants of each camera
    t: Array
    speed: Array  # (2, n, 6) rates of the POSE_COMPONENTS
    rig: StereoRig
    disc: Disc
    values: Mapping[str, float]
    images: DotImages


class Fault:
    """One thing that may be wrong about the measurement."""

    family: str  # name, but for the camera's or the dot's
    title: str
    source: str
    unit: str
    step: float  # of a fit: a hundredth of a pixel or so in the image
    parts: tuple[str, ...]  # its numbers
    meaning: str
    bounds: tuple[float, float] = (-np.inf, np.inf)  # beyond which no laboratory's lies
    in_images: bool = False  # adds its number times `column` to the dots' images
    belongs_to: tuple[str, ...] = ("rig",)  # what two recordings must have in common to share it
    of_poses_alone: bool = True  # may show in dots about free poses, without a model of the motion

    @property
    def name(self) -> str:
        """Unique; quantities are "name.part"."""
        return self.family

    def names(self) -> tuple[str, ...]:
        """Of its quantities."""
        return tuple(f"{self.name}.{part}" for part in self.parts)

    def candidate(self) -> Candidate:
        """For the engine."""
        several = len(self.parts) > 1
        low, high = self.bounds
        quantities = tuple(
            Quantity(
                name,
                self.unit,
                self.step,
                lower=low,
                upper=high,
                meaning=f"{self.meaning} ({part})" if several else self.meaning,
                typical=TYPICAL_STEPS * self.step,
                belongs_to=self.belongs_to,
            )
            for name, part in zip(self.names(), self.parts, strict=True)
        )
        return Candidate(self.name, self.name, "measurement", self.said(), self.source, quantities)

    def said(self) -> str:
        """The title with what it befell."""
        return self.title

    def numbers(self, values: Mapping[str, float]) -> Array:
        """Its numbers among the values; zero where they are not."""
        return np.array([float(values.get(name, 0.0)) for name in self.names()])

    def alter(self, setup: MeasurementSetup, v: Array) -> None:
        """Write its numbers v into the setup."""

    def column(self, part: str, sight: Sight) -> Array:
        """Derivative (n, 2, m, 2) of the dots' images by one of its numbers.

        By central difference: what `alter` changes acts smoothly and nearly linearly, and this holds to 1e-8 of it.
        """
        name, sides = f"{self.name}.{part}", []
        for sign in (1.0, -1.0):
            changed = dict(sight.values) | {name: sight.values.get(name, 0.0) + sign * self.step}
            sides.append(predict(sight.R, sight.t, sight.rig, sight.disc, changed).pixels)
        return (sides[0] - sides[1]) / (2 * self.step)

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        """The scene's faults with these numbers."""
        raise NotImplementedError

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        """Inverse of `to_scene`."""
        raise NotImplementedError


class TimeOffset(Fault):
    """A delay of one camera."""

    family, unit, step, parts = "time_offset", "s", 1e-5, ("delay",)
    title = "the right camera exposes later than the left"
    source, meaning = "synchronisation of the cameras", "right minus left"
    bounds = (-0.05, 0.05)

    def alter(self, setup: MeasurementSetup, v: Array) -> None:
        setup.delay = float(v[0])

    def column(self, part: str, sight: Sight) -> Array:
        moved = np.zeros_like(sight.images.pixels)
        moved[:, 1] = np.einsum("nmap,np->nma", sight.images.by_pose[:, 1], sight.speed[1])
        return moved

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        return replace(faults, right_delay_s=float(v[0]))

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        return (faults.right_delay_s,)


class FrameRate(Fault):
    """A clock that runs at another rate."""

    family, unit, step, parts = "frame_rate", "1", 1e-4, ("change",)
    title = "the true frame rate differs from the declared one"
    source, meaning = "clock of the cameras", "true over declared minus one"
    bounds = (-0.6, 1.2)
    of_poses_alone = False

    def alter(self, setup: MeasurementSetup, v: Array) -> None:
        setup.rate = 1.0 + float(v[0])

    def column(self, part: str, sight: Sight) -> Array:
        rate = 1.0 + self.numbers(sight.values)[0]
        earlier = -sight.speed * ((sight.time - sight.time[0]) / rate**2)[:, None]
        return np.einsum("ncmap,cnp->ncma", sight.images.by_pose, earlier)

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        return replace(faults, frame_rate_hz=scene.cameras.frame_rate_hz * (1.0 + float(v[0])) if v[0] else 0.0)

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        return (faults.frame_rate_hz / scene.cameras.frame_rate_hz - 1.0 if faults.frame_rate_hz else 0.0,)


@dataclass(frozen=True)
class Keyed(Fault):
    """What a key of its own in a scene holds, as null + factor times its numbers, and a field of the setup as well."""

    family: str
    parts: tuple[str, ...]
    unit: str
    step: float
    title: str
    source: str
    meaning: str
    key: str  # of the scene's Faults, or CameraFault
    sets: tuple[str, slice | int | None]  # field of the setup, or of its CameraChange, and which of its numbers
    factor: float = 1.0
    null: float = 0.0
    bounds: tuple[float, float] = (-np.inf, np.inf)
    belongs_to: tuple[str, ...] = ("rig",)
    camera: str = ""  # that it befell, if it befalls cameras

    @property
    def name(self) -> str:
        return f"{self.camera}_{self.family}" if self.camera else self.family

    def said(self) -> str:
        return self.title.format(self.camera)

    def alter(self, setup: MeasurementSetup, v: Array) -> None:
        changed = setup.cameras[CAMERAS.index(self.camera)] if self.camera else setup
        field_, numbers = self.sets
        if numbers is None:
            setattr(changed, field_, v if len(v) > 1 else float(v[0]))
        else:
            getattr(changed, field_)[numbers] = v if isinstance(numbers, slice) else v[0]

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        numbers = tuple(float(self.null + self.factor * x) for x in v)
        keyed: dict[str, Any] = {self.key: numbers if len(numbers) > 1 else numbers[0]}
        if self.camera:
            return replace(faults, **{self.camera: replace(getattr(faults, self.camera), **keyed)})
        return replace(faults, **keyed)

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        place = getattr(faults, self.camera) if self.camera else faults
        return list((np.atleast_1d(getattr(place, self.key)) - self.null) / self.factor)


_DEG = 180 / np.pi
_ALL = slice(None)
OF_CAMERAS = (
    Keyed("turned", ("rotation_x", "rotation_y", "rotation_z"), "rad", 1e-5,
          "the {} camera turned after its calibration", "mount, cable, knock", "in its own axes",
          "rotation_deg", ("rotation", _ALL), _DEG, bounds=(-0.06, 0.06)),
    Keyed("shifted", ("translation_x", "translation_y", "translation_z"), "m", 1e-5,
          "the {} camera moved after its calibration", "mount, cable, knock", "in its own axes",
          "translation_mm", ("translation", _ALL), 1e3, bounds=(-0.01, 0.01)),
    Keyed("focal", ("change",), "1", 1e-5, "the focal length of the {} camera changed", "focus, temperature",
          "relative", "focal_scale", ("focal", None), null=1.0, bounds=(-0.05, 0.05)),
    Keyed("principal_point", ("x", "y"), "px", 0.01, "the principal point of the {} camera moved", "lens not fixed",
          "in the image", "principal_point_change_px", ("centre", _ALL), bounds=(-5.0, 5.0)),
    Keyed("distortion", ("k1",), "1", 1e-3, "the distortion of the {} camera changed", "focus, aperture, other lens",
          "change of Brown's k1", "k1_change", ("k1", None), bounds=(-1.0, 1.0)),
)  # fmt: skip
OF_THE_PAPER = (
    Keyed("pattern_offset", ("x", "y"), "m", 1e-6, "the dots as a whole are off the disc's centre",
          "gluing of the paper", "body axes", "pattern_offset_mm", ("pattern_offset", slice(2)), 1e3,
          belongs_to=("disc",)),
    Keyed("pattern_rotation", ("angle",), "rad", 1e-5, "the dots as a whole are turned on the face",
          "gluing; the same as another spin angle", "about e3", "pattern_turn_deg", ("pattern_turn", None), _DEG,
          belongs_to=("disc",)),
    Keyed("pattern_scale", ("change",), "1", 1e-5, "the dots as a whole are printed too large", "printer", "relative",
          "pattern_scale", ("pattern_growth", None), null=1.0, belongs_to=("disc",)),
    Keyed("pattern_height", ("offset",), "m", 1e-6, "the dots lie higher than half the thickness",
          "paper, glue, thickness", "along e3", "pattern_height_mm", ("pattern_offset", 2), 1e3, belongs_to=("disc",)),
)  # fmt: skip
OF_THE_TABLE = (
    Keyed("table_plane", ("tilt_x", "tilt_y"), "rad", 1e-5,
          "the table is not parallel to the calibration's table view", "board on a burr",
          "turn of the true table, calibrated axes", "table_turn_deg", ("table_turn", slice(2)), _DEG),
    Keyed("table_height", ("offset",), "m", 1e-6, "the table is not where the calibration's table view says",
          "thickness of the board", "true height of the table in the calibrated axes", "table_height_mm",
          ("table_height", None), 1e3),
)  # fmt: skip


class Misprint(Fault):
    """One dot out of its place."""

    belongs_to = ("disc",)
    family, unit, step, parts = "misprint", "m", 1e-6, ("x", "y")
    title = "dot {} is not where it was declared"
    source, meaning = "printing", "body axes"

    def __init__(self, dot: int) -> None:
        self.dot = dot

    @property
    def name(self) -> str:
        return f"misprint_{self.dot}"

    def said(self) -> str:
        return self.title.format(self.dot)

    def alter(self, setup: MeasurementSetup, v: Array) -> None:
        setup.misprint[self.dot] = v

    def column(self, part: str, sight: Sight) -> Array:
        moved = np.zeros_like(sight.images.pixels)
        along = sight.R[:, :, :, self.parts.index(part)]  # (2, n, 3) body axis in the world
        moved[:, :, self.dot] = np.einsum("ncap,cnp->nca", sight.images.by_pose[:, :, self.dot, :, :3], along)
        return moved

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        places = list(faults.misprint_mm or [(0.0, 0.0)] * len(scene.markers.centres_mm))
        places[self.dot] = (1e3 * float(v[0]), 1e3 * float(v[1]))
        return replace(faults, misprint_mm=tuple(places))

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        return tuple(1e-3 * x for x in faults.misprint_mm[self.dot]) if faults.misprint_mm else (0.0, 0.0)


class ExposureBlur(Fault):
    """A long exposure."""

    family, unit, step, parts = "exposure_blur", "s^2", 1e-7, ("T2",)
    title = "dots are averaged over an exposure"
    source, meaning = "centre moves by T^2/24 times its acceleration", "square of the exposure"
    bounds = (0.0, 1e-3)
    in_images = True
    of_poses_alone = False  # takes the second derivative of the images

    def column(self, part: str, sight: Sight) -> Array:
        """Second derivative of the dots' images by differences over neighbouring frames."""
        twice = np.gradient(np.gradient(sight.images.pixels, sight.time, axis=0), sight.time, axis=0)
        return np.asarray(twice, float) / 24

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        return replace(faults, exposure_s=float(np.sqrt(max(v[0], 0.0))))

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        return (faults.exposure_s**2,)


class EllipseCentre(Fault):
    """Centres of images for images of centres."""

    family, unit, step, parts = "ellipse_centre", "1", 0.1, ("share",)
    title = "centres of ellipses were taken for images of the centres"
    source, meaning = "perspective of circles", "1: not corrected at all, -1: corrected twice"
    bounds = (-2.0, 2.0)
    in_images = True

    def column(self, part: str, sight: Sight) -> Array:
        return ellipse_centre_shift(sight.R[0], sight.t[0], sight.rig, sight.disc)

    def to_scene(self, faults: Faults, v: Array, scene: Scene) -> Faults:
        return replace(faults, ellipse_centre_share=float(v[0]))

    def from_scene(self, faults: Faults, scene: Scene) -> Sequence[float]:
        return (faults.ellipse_centre_share,)


def faults_of(disc: Disc) -> tuple[Fault, ...]:
    """All that may be wrong about the measurement of this disc."""
    of_cameras = (replace(fault, camera=camera) for fault in OF_CAMERAS for camera in CAMERAS)
    misprints = (Misprint(i) for i in range(disc.n_markers))
    return (
        TimeOffset(), FrameRate(), *of_cameras, *misprints, *OF_THE_PAPER, *OF_THE_TABLE, ExposureBlur(),
        EllipseCentre(),
    )  # fmt: skip


def measurement_candidates(disc: Disc) -> tuple[Candidate, ...]:
    """The same as candidates of the engine."""
    return tuple(fault.candidate() for fault in faults_of(disc))


def setup_of(disc: Disc, values: Mapping[str, float]) -> MeasurementSetup:
    """How the measurement differs from what was declared where faults have these values; those absent are null."""
    setup = MeasurementSetup(np.zeros((disc.n_markers, 2)))
    for fault in faults_of(disc):
        v = fault.numbers(values)
        if v.any():
            fault.alter(setup, v)
    return setup


def scene_faults(disc: Disc, values: Mapping[str, float], scene: Scene) -> Faults:
    """Faults of a scene with this disc and these values."""
    found = Faults()
    for fault in faults_of(disc):
        v = fault.numbers(values)
        if v.any():
            found = fault.to_scene(found, v, scene)
    return found


def values_in_scene(disc: Disc, scene: Scene) -> dict[str, float]:
    """Inverse of `scene_faults`: the values that are not null."""
    pairs = [
        pair
        for fault in faults_of(disc)
        for pair in zip(fault.names(), fault.from_scene(scene.faults, scene), strict=True)
    ]
    return {name: float(value) for name, value in pairs if value}


def predict(R: Array, t: Array, rig: StereoRig, disc: Disc, values: Mapping[str, float]) -> DotImages:
    """Images of the dots' centres for poses per camera R (2, n, 3, 3), t (2, n, 3), body -> world.

    values : of the faults; those that act on clocks or images have no part in this
    """
    setup = setup_of(disc, values)
    centres = setup.centres(disc)
    tilt = rotation_from_vector(setup.table_turn)
    height = np.array([0.0, 0.0, setup.table_height])
    pixels, by_pose = [], []
    for i, (camera, (R_cw, t_cw), change) in enumerate(
        zip(rig.cameras, rig.camera_poses(), setup.cameras, strict=True)
    ):
        arm = centres @ np.swapaxes(R[i], 1, 2)
        world = (arm + t[i][:, None]) @ tilt.T + height
        turn = rotation_from_vector(change.rotation).T
        in_camera = (world @ R_cw.T + t_cw - change.translation) @ turn.T
        view, d_point, _ = project_with_jacobians(in_camera, change.lens(camera))
        d_world = d_point @ (turn @ R_cw @ tilt)
        pixels.append(view)
        by_pose.append(np.concatenate([d_world, np.cross(arm[..., None, :], d_world)], axis=-1))
    return DotImages(np.stack(pixels, axis=1), np.stack(by_pose, axis=1))


def ellipse_centre_shift(R: Array, t: Array, rig: StereoRig, disc: Disc) -> Array:
    """Centre of the dots' images minus image of their centres (n, 2, m, 2) [px]; R (n, 3, 3), t (n, 3).

    The image of a circle is an ellipse, to the lens' distortion; its centre is that of the area inside.
    """
    angles = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    ring = 0.5 * disc.marker_diameter * np.stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)], axis=-1)
    body = np.concatenate([disc.marker_centres_body[:, None], disc.marker_centres_body[:, None] + ring], axis=1)
    world = body.reshape(-1, 3) @ np.swapaxes(R, 1, 2) + t[:, None]
    images = np.moveaxis(rig.project(world), -3, 1)  # (n, 2, m * (1 + rim), 2)
    images = images.reshape(*images.shape[:2], disc.n_markers, 1 + RIM_POINTS, 2)
    centre, outline = images[..., 0, :], images[..., 1:, :] - images[..., :1, :]
    following = np.roll(outline, -1, axis=-2)
    cross = outline[..., 0] * following[..., 1] - outline[..., 1] * following[..., 0]
    shift = np.sum((outline + following) * cross[..., None], axis=-2) / (3 * np.sum(cross, axis=-1))[..., None]
    return np.where(np.isfinite(centre), shift, 0.0)
