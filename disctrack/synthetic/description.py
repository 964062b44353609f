"""What a synthetic recording shows: every property of cameras, light, disc, board, motion and faults, with its default.

A scene is a tree of frozen dataclasses and a TOML file of the same shape. Grey values are those of an 8-bit sensor
(0 to 255) whatever the bit depth. Lengths in mm, angles in degrees, times in s, as the names say; all that a key does
not say takes the default below, which resembles the experiment of Ma et al. 2014, section 3 (1000 pairs/s of 512 x 512,
0.25 mm per pixel). Every random choice follows from `seed`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from disctrack.disc import AIR_DENSITY, MA_2014, Disc, disc_from_mm
from disctrack.errors import SceneError
from disctrack.faults.keys import Faults
from disctrack.files.toml_tree import build, read_toml, toml_lines

Pair = tuple[float, float]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class CameraSettings:
    """Timing and format of the two cameras."""

    frame_rate_hz: float = 1000.0
    n_frames: int = 200  # for moving discs; static poses give one frame each
    image_size: tuple[int, int] = (512, 512)  # width, height [px]
    exposure_s: float = 0.0002  # frame i is exposed from i / frame_rate - exposure / 2 to + exposure / 2
    bit_depth: int = 8  # 8, 10, 12 or 16; more than 8 is written as 16-bit files


@dataclass(frozen=True)
class RigSettings:
    """Where the cameras stand and what lenses they have; `variation` scales the seeded differences between rigs."""

    mm_per_px: float = 0.25  # at the point both cameras look at
    distance_mm: Pair = (420.0, 420.0)
    off_vertical_deg: Pair = (42.0, 42.0)
    azimuth_deg: Pair = (-122.0, -53.0)  # of the camera seen from the target, from world axis i towards j
    roll_deg: Pair = (0.0, 0.0)
    target_mm: Triple = (32.0, 20.0, 4.0)  # world point on both optical axes, before variation
    k1: Pair = (-0.11, -0.12)
    k2: Pair = (0.25, 0.22)
    p1: Pair = (4e-4, -3e-4)
    p2: Pair = (-3e-4, 5e-4)
    k3: Pair = (0.0, 0.0)
    variation: float = 1.0  # 1: scatter of 2 deg, 10 mm, 4 px of the principal point, 0.5 % of focal length, ...


@dataclass(frozen=True)
class OpticsSettings:
    """Blur and fall-off of the lenses."""

    blur_px: Pair = (0.60, 0.65)  # standard deviation of the Gaussian point spread, left and right, without the pixel
    vignetting: float = 0.04  # loss of light at the image's corner


@dataclass(frozen=True)
class SensorSettings:
    """From light to grey values. Defaults have the noise of a machine-vision camera: variance 0.64 + grey / 50 DN^2."""

    gain_e_per_dn: float = 50.0  # photo-electrons per 8-bit grey level; 0: no shot noise
    read_noise_dn: float = 0.8
    black_level_dn: float = 0.0
    hot_pixels: int = 0  # per camera
    hot_pixel_dn: float = 60.0  # mean excess of a hot pixel, exponentially distributed


@dataclass(frozen=True)
class GlareSettings:
    """A reflex of a lamp in a lens: a Gaussian spot fixed in the image, moving with neither disc nor table."""

    camera: str = "left"
    centre_px: Pair = (256.0, 256.0)
    sigma_px: float = 40.0
    grey: float = 20.0


@dataclass(frozen=True)
class LightSettings:
    """The lamp: a gradient over the table, and how far brightness follows the face's inclination to it."""

    gradient_per_m: Pair = (0.0, 0.0)  # relative change of brightness per metre along world i, j
    directed: float = 0.10  # share of light that comes from `direction`; the rest comes from everywhere
    direction: Triple = (0.2, 0.3, 1.0)
    glare: tuple[GlareSettings, ...] = ()


@dataclass(frozen=True)
class ImperfectionSettings:
    """What every laboratory has and nobody declares; off by default. Lenses and sensors are drawn by the seed."""

    lens_field_px: float = 0.0  # rms per axis of a smooth displacement beyond the lens' polynomial
    board_bow_mm: float = 0.0  # middle of the board above its short sides (negative: below)
    board_stretch: float = 0.0  # relative, of the squares along the long side
    pixel_gain: float = 0.0  # rms of the pixels' gains about 1
    column_offset_dn: float = 0.0  # rms of the columns' offsets
    response_curve: float = 0.0  # largest departure of grey values from a straight line, of full scale


@dataclass(frozen=True)
class AppearanceSettings:
    """Grey values of the surfaces under full light, and the table's texture (fixed to the world)."""

    paper: float = 190.0
    dot: float = 25.0
    rim: float = 118.0  # bare steel ring of the upper face
    rim_width_mm: float = 1.5
    side: float = 58.0
    underside: float = 90.0
    board_white: float = 200.0
    board_black: float = 20.0
    table: float = 85.0
    table_streaks: float = 3.0  # standard deviation of the brushed texture
    table_blotches: float = 2.0  # standard deviation of the soft spots
    streak_direction_deg: float = 90.0  # from world axis i


@dataclass(frozen=True)
class DiscSettings:
    """The disc as declared in recording.toml."""

    radius_mm: float = 37.5
    thickness_mm: float = 6.0
    mass_g: float = 209.69


def _default_centres() -> tuple[Pair, ...]:
    return tuple((round(float(x), 4), round(float(y), 4)) for x, y in MA_2014.marker_centres_body[:, :2] * 1e3)


@dataclass(frozen=True)
class MarkerSettings:
    """The dots as declared in recording.toml."""

    diameter_mm: float = 7.0
    centres_mm: tuple[Pair, ...] = field(default_factory=_default_centres)


@dataclass(frozen=True)
class BoardSettings:
    """The chessboard and its views; view 0 lies flat on the table."""

    n_views: int = 20
    inner_corners: tuple[int, int] = (9, 6)
    square_mm: float = 8.0
    margin_mm: float = 8.0  # white paper round the squares
    thickness_mm: float = 3.0
    max_tilt_deg: float = 38.0
    max_turn_deg: float = 35.0
    shift_mm: float = 22.0
    height_mm: Pair = (5.0, 40.0)  # of the board's middle above the table in the tilted views


@dataclass(frozen=True)
class RollingMotion:
    """Motion from the rolling model: regular precession with a nutation oscillation, losing energy to the effects."""

    theta_deg: float = 20.0
    psi_deg: float = 0.0
    phi_deg: float = 0.0
    centre_mm: Pair = (32.0, 20.0)  # of the disc at the first frame
    omega3_rad_s: float = math.nan  # spin about the axis; nan: as much as keeps the centre at rest
    nutation_deg: float = 0.05  # amplitude of the oscillation on top of regular precession
    nutation_phase_deg: float = 0.0
    state: dict[str, float] = field(default_factory=dict)  # components of rolling.State [SI] that replace the above
    struck: dict[str, float] = field(default_factory=dict)  # in place of all that: upright and at rest, hit by a ball;
    # lateral_mm, vertical_mm from the middle of the upper face, impulse_N_s, friction of the table during the impact
    effects: dict[str, dict[str, float]] = field(
        default_factory=lambda: {"km": {"k_m": 0.381e-7}, "kn": {"k_n": 0.381e-7}, "kz": {"k_z": 1e-5}}
    )
    # by their names in rolling.CATALOGUE; who names one names all, and numbers not given are zero (effects_from_tables)
    formulas: dict[str, dict[str, str]] = field(default_factory=dict)  # laws of further effects: component -> formula


@dataclass(frozen=True)
class MotionSettings:
    """One source of motion: poses (one frame each), a table over time, or the rolling model.

    Poses are rows of x, y, z [mm], psi, theta, phi [deg]; `table` names a CSV or NPY file beside the scene with rows
    t [s], x, y, z [m], psi, theta, phi [rad] (cubic spline between them).
    """

    kind: str = "static"  # static, table or rolling
    poses: tuple[tuple[float, ...], ...] = ((32.0, 20.0, 12.0, 30.0, 15.0, 40.0),)
    table: str = ""
    rolling: RollingMotion = field(default_factory=RollingMotion)


@dataclass(frozen=True)
class RenderSettings:
    """Fineness of the computation, not of the scene."""

    subpixels: int = 5  # cells per pixel and axis where an edge passes
    threads: int = 2
    png_compression: int = 3  # 0 to 9


@dataclass(frozen=True)
class Scene:
    """Everything that determines a synthetic recording."""

    name: str = "scene"
    seed: int = 1
    gravity_m_s2: float = 9.81
    air_density_kg_m3: float = AIR_DENSITY
    cameras: CameraSettings = field(default_factory=CameraSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    light: LightSettings = field(default_factory=LightSettings)
    appearance: AppearanceSettings = field(default_factory=AppearanceSettings)
    disc: DiscSettings = field(default_factory=DiscSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)
    board: BoardSettings = field(default_factory=BoardSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    faults: Faults = field(default_factory=Faults)
    imperfections: ImperfectionSettings = field(default_factory=ImperfectionSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    folder: Path = Path()  # where files named in the scene are looked for; set by load_scene

    @property
    def declared_disc(self) -> Disc:
        """The disc that recording.toml describes."""
        d = self.disc
        return disc_from_mm(
            d.radius_mm, d.thickness_mm, d.mass_g, [list(c) for c in self.markers.centres_mm], self.markers.diameter_mm
        )


def load_scene(path: str | Path) -> Scene:
    """Scene of a TOML file; what it does not say takes its default.

    Raises SceneError for a file that cannot be read, an unknown key (naming the nearest known one) and a value of the
    wrong kind.
    """
    path = Path(path)
    return scene_from_tree(read_toml(path, SceneError), where=str(path), folder=path.parent)


def scene_from_tree(tree: dict[str, Any], where: str = "scene", folder: Path = Path()) -> Scene:
    """Scene of nested dictionaries as tomllib returns them; errors as in `load_scene`."""
    scene = replace(build(Scene, tree, where), folder=folder)
    _check(scene, where)
    return scene


def scene_toml(scene: Scene) -> str:
    """All of `scene` as a TOML file that `load_scene` reads back to the same scene (but for its folder)."""
    return "\n".join(toml_lines(scene)).lstrip() + "\n"


MOST = 1e7  # no length, angle, rate, grey value or number of frames of a laboratory is larger in its unit
MOST_PIXELS = 16384  # a side
_NOT_NEGATIVE = {
    "rig.variation",
    "optics.vignetting",
    *(f"sensor.{name}" for name in ("gain_e_per_dn", "read_noise_dn", "hot_pixels", "hot_pixel_dn")),
    *(f"board.{name}" for name in ("margin_mm", "thickness_mm", "max_tilt_deg", "max_turn_deg", "shift_mm")),
    *(f"appearance.{name}" for name in ("table_streaks", "table_blotches", "rim_width_mm")),
    *(f"imperfections.{name}" for name in ("lens_field_px", "pixel_gain", "column_offset_dn")),
    "cameras.exposure_s",
    "faults.exposure_s",
    "faults.frame_rate_hz",
    "faults.misprint_sigma_mm",
    "render.png_compression",
    "seed",
}
_POSITIVE = {
    "cameras.frame_rate_hz",
    "rig.mm_per_px",
    "rig.distance_mm",
    "disc.radius_mm",
    "disc.thickness_mm",
    "disc.mass_g",
    "markers.diameter_mm",
    "board.square_mm",
    "gravity_m_s2",
    "air_density_kg_m3",
    "faults.pattern_scale",
    "faults.left.focal_scale",
    "faults.right.focal_scale",
    "light.glare.sigma_px",
    "faults.occluders.width_px",
    "faults.occluders.length_px",
}


def _numbers(item: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a scene with its key, but those that say by nan that they are not given."""
    if is_dataclass(item):
        for entry in fields(item):
            value = getattr(item, entry.name)
            if not (isinstance(value, float) and math.isnan(value) and entry.name == "omega3_rad_s"):
                yield from _numbers(value, f"{path}.{entry.name}" if path else entry.name)
    elif isinstance(item, dict):
        for name, value in item.items():
            yield from _numbers(value, f"{path}.{name}")
    elif isinstance(item, tuple | list):
        for value in item:
            yield from _numbers(value, path)
    elif isinstance(item, int | float) and not isinstance(item, bool):
        yield path, item


def _check(scene: Scene, where: str) -> None:
    """Raise SceneError for values that no recording can have."""
    for key, value in _numbers(scene):
        least, most = 0.0 if key in _NOT_NEGATIVE else -MOST, math.inf if isinstance(value, int) else MOST
        if not least <= value <= most:  # nan, too
            raise SceneError(f"{where}: {key} = {value}; expected a number from {least:g} to {most:g}")
        if key in _POSITIVE and not 1 / MOST <= value <= MOST:  # its reciprocal is a number, too
            raise SceneError(f"{where}: {key} = {value}; expected a positive number, from {1 / MOST:g} to {MOST:g}")
    for bad, key, found, expected in (*_of_the_disc(scene), *_of_the_images(scene), *_of_the_rest(scene)):
        if bad:
            raise SceneError(f"{where}: {key} = {found}; expected {expected}")


_Complaint = tuple[bool, str, object, str]  # is it so, key, what was found, what was expected


def _of_the_disc(scene: Scene) -> Iterator[_Complaint]:
    centres, hidden, misprints = scene.markers.centres_mm, scene.faults.hidden_markers, scene.faults.misprint_mm
    n = len(centres)
    reach_mm = max((math.hypot(x, y) for x, y in centres), default=0.0) + scene.markers.diameter_mm / 2
    yield n < 3, "markers.centres_mm", f"{n} rows", "3 or more"
    yield reach_mm > scene.disc.radius_mm, "markers.centres_mm", "a dot over the disc's rim", "dots on the face"
    yield len(misprints) not in (0, n), "faults.misprint_mm", f"{len(misprints)} rows", f"one per dot ({n})"
    outside = any(not 0 <= k < n for k in hidden)
    yield outside, "faults.hidden_markers", hidden, f"numbers from 0 to {n - 1}"


def _of_the_images(scene: Scene) -> Iterator[_Complaint]:
    cameras, render, size = scene.cameras, scene.render, scene.cameras.image_size
    yield cameras.bit_depth not in (8, 10, 12, 16), "cameras.bit_depth", cameras.bit_depth, "8, 10, 12, 16"
    yield not 1 <= cameras.n_frames <= MOST, "cameras.n_frames", cameras.n_frames, f"1 to {MOST:.0f}"
    yield min(size) < 16, "cameras.image_size", size, "at least 16 x 16"
    yield max(size) > MOST_PIXELS, "cameras.image_size", size, f"at most {MOST_PIXELS} pixels a side"
    hot = scene.sensor.hot_pixels
    yield hot > math.prod(size), "sensor.hot_pixels", hot, f"no more than the {math.prod(size)} pixels of an image"
    light = scene.light
    yield not light.direction[2] > 0, "light.direction", light.direction, "a lamp above the table: the third above 0"
    yield not 0 <= light.directed <= 1, "light.directed", light.directed, "a share, 0 to 1"
    yield min(scene.optics.blur_px) < 0.2, "optics.blur_px", scene.optics.blur_px, "0.2 px or more"
    yield render.png_compression > 9, "render.png_compression", render.png_compression, "0 to 9"
    yield render.threads < 1, "render.threads", render.threads, "1 or more"
    yield render.subpixels < 2, "render.subpixels", render.subpixels, "2 or more"


def _of_the_rest(scene: Scene) -> Iterator[_Complaint]:
    board, kind = scene.board, scene.motion.kind
    empty = board.n_views < 1 or min(board.inner_corners) < 2
    yield empty, "board", "no view or no corner", "n_views >= 1, corners >= 2"
    upside_down = board.height_mm[0] > board.height_mm[1]
    yield upside_down, "board.height_mm", board.height_mm, "the lower, then the higher"
    yield kind not in ("static", "table", "rolling"), "motion.kind", kind, "static, table, rolling"
    short = any(len(p) != 6 for p in scene.motion.poses)
    yield short, "motion.poses", "rows", "6 numbers each: x y z mm, psi theta phi deg"
    named = {g.camera for g in scene.light.glare} | {r.camera for r in scene.faults.occluders}
    yield not named <= {"left", "right"}, "camera of a glare or occluder", "another word", "left or right"
