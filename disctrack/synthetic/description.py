"""The scene of a synthetic recording: properties of cameras, light, disc, board, motion and faults, with defaults.

A scene is a tree of frozen dataclasses and a TOML file of the same structure. Grey values are those of an 8-bit sensor
(0 to 255) for every bit depth. Lengths in mm, angles in degrees, times in s, as the names say. Missing keys have the
defaults below, which resemble the experiment of Ma et al. 2014, section 3 (1000 pairs/s of 512 x 512, 0.25 mm per
pixel). All random numbers follow from `seed`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from disctrack.disc import AIR_DENSITY, MA_2014, Disc, disc_from_mm
from disctrack.errors import SceneError
from disctrack.faults.keys import Faults, Pair, Triple
from disctrack.files.toml_tree import MOST, NOT_NEGATIVE, POSITIVE, build, limited, read_toml, toml_lines

Pose = tuple[float, float, float, float, float, float]
MOST_PIXELS = 16384  # per side of an image


@dataclass(frozen=True)
class CameraSettings:
    """Timing and format of the two cameras."""

    frame_rate_hz: float = limited(1000.0, POSITIVE)
    n_frames: int = limited(200, (1, MOST))  # for moving discs; static poses give one frame each
    image_size: tuple[int, int] = limited((512, 512), (16, MOST_PIXELS))  # width, height [px]
    # frame i is exposed from i / frame_rate - exposure / 2 to + exposure / 2
    exposure_s: float = limited(0.0002, NOT_NEGATIVE)
    bit_depth: int = 8  # 8, 10, 12 or 16; more than 8 is written as 16-bit files


@dataclass(frozen=True)
class RigSettings:
    """Poses and lenses of the cameras; `variation` scales the seeded differences between rigs."""

    mm_per_px: float = limited(0.25, POSITIVE)  # at the target
    distance_mm: tuple[float, float] = limited((420.0, 420.0), POSITIVE)
    off_vertical_deg: Pair = (42.0, 42.0)
    azimuth_deg: Pair = (-122.0, -53.0)  # direction from the target to the camera, from world axis i towards j
    roll_deg: Pair = (0.0, 0.0)
    target_mm: Triple = (32.0, 20.0, 4.0)  # world point on both optical axes, before variation
    k1: Pair = (-0.11, -0.12)
    k2: Pair = (0.25, 0.22)
    p1: Pair = (4e-4, -3e-4)
    p2: Pair = (-3e-4, 5e-4)
    k3: Pair = (0.0, 0.0)
    # 1: scatter of 2 deg, 10 mm, 4 px of the principal point, 0.5 % of focal length, ...
    variation: float = limited(1.0, NOT_NEGATIVE)


@dataclass(frozen=True)
class OpticsSettings:
    """Blur and vignetting of the lenses."""

    # standard deviation of the Gaussian point spread function, left and right, without that of the pixel
    blur_px: tuple[float, float] = limited((0.60, 0.65), (0.2, MOST))
    vignetting: float = limited(0.04, NOT_NEGATIVE)  # relative loss of light at the corners of the image


@dataclass(frozen=True)
class SensorSettings:
    """From light to grey values. Defaults have the noise of a machine-vision camera: variance 0.64 + grey / 50 DN^2."""

    gain_e_per_dn: float = limited(50.0, NOT_NEGATIVE)  # photo-electrons per 8-bit grey level; 0: no shot noise
    read_noise_dn: float = limited(0.8, NOT_NEGATIVE)
    black_level_dn: float = 0.0
    hot_pixels: int = limited(0, NOT_NEGATIVE)  # per camera
    hot_pixel_dn: float = limited(60.0, NOT_NEGATIVE)  # mean excess of a hot pixel, exponentially distributed


@dataclass(frozen=True)
class GlareSettings:
    """A reflection of a lamp in a lens: a Gaussian spot fixed in the image."""

    camera: str = "left"
    centre_px: Pair = (256.0, 256.0)
    sigma_px: float = limited(40.0, POSITIVE)
    grey: float = 20.0


@dataclass(frozen=True)
class LightSettings:
    """The lamp: gradient over the table, and dependence of the brightness of a face on its inclination."""

    gradient_per_m: Pair = (0.0, 0.0)  # relative change of brightness per metre along world i, j
    # share of light from `direction`; the rest is diffuse
    directed: float = limited(0.10, (0, 1))
    direction: Triple = (0.2, 0.3, 1.0)
    glare: tuple[GlareSettings, ...] = ()


@dataclass(frozen=True)
class ImperfectionSettings:
    """Usual undeclared imperfections of a laboratory; off by default. Lenses and sensors are drawn from the seed."""

    # rms per axis of a smooth displacement in addition to the lens' distortion polynomial
    lens_field_px: float = limited(0.0, NOT_NEGATIVE)
    board_bow_mm: float = 0.0  # height of the middle of the board over its short sides
    board_stretch: float = 0.0  # relative, of the squares along the long side
    pixel_gain: float = limited(0.0, NOT_NEGATIVE)  # rms of the pixels' gains about 1
    column_offset_dn: float = limited(0.0, NOT_NEGATIVE)  # rms of the columns' offsets
    response_curve: float = 0.0  # largest nonlinearity of grey values, relative to full scale


@dataclass(frozen=True)
class AppearanceSettings:
    """Grey values of the surfaces under full light, and the table's texture (fixed to the world)."""

    paper: float = 190.0
    dot: float = 25.0
    rim: float = 118.0  # bare steel ring of the upper face
    rim_width_mm: float = limited(1.5, NOT_NEGATIVE)
    side: float = 58.0
    underside: float = 90.0
    board_white: float = 200.0
    board_black: float = 20.0
    table: float = 85.0
    table_streaks: float = limited(3.0, NOT_NEGATIVE)  # standard deviation of the brushed texture
    table_blotches: float = limited(2.0, NOT_NEGATIVE)  # standard deviation of the smooth spots
    streak_direction_deg: float = 90.0  # from world axis i


@dataclass(frozen=True)
class DiscSettings:
    """The disc as declared in recording.toml."""

    radius_mm: float = limited(37.5, POSITIVE)
    thickness_mm: float = limited(6.0, POSITIVE)
    mass_g: float = limited(209.69, POSITIVE)


def _default_centres() -> tuple[Pair, ...]:
    return tuple((round(float(x), 4), round(float(y), 4)) for x, y in MA_2014.marker_centres_body[:, :2] * 1e3)


@dataclass(frozen=True)
class MarkerSettings:
    """The dots as declared in recording.toml."""

    diameter_mm: float = limited(7.0, POSITIVE)
    centres_mm: tuple[Pair, ...] = field(default_factory=_default_centres)


@dataclass(frozen=True)
class BoardSettings:
    """The chessboard and its views; view 0 lies flat on the table."""

    n_views: int = limited(20, (1, MOST))
    inner_corners: tuple[int, int] = limited((9, 6), (2, MOST))
    square_mm: float = limited(8.0, POSITIVE)
    margin_mm: float = limited(8.0, NOT_NEGATIVE)  # white paper around the squares
    thickness_mm: float = limited(3.0, NOT_NEGATIVE)
    max_tilt_deg: float = limited(38.0, NOT_NEGATIVE)
    max_turn_deg: float = limited(35.0, NOT_NEGATIVE)
    shift_mm: float = limited(22.0, NOT_NEGATIVE)
    height_mm: Pair = (5.0, 40.0)  # range of the height of the board's middle above the table in the tilted views


@dataclass(frozen=True)
class RollingMotion:
    """Motion of the rolling model: regular precession with a nutation oscillation, with dissipation by the effects."""

    theta_deg: float = 20.0
    psi_deg: float = 0.0
    phi_deg: float = 0.0
    centre_mm: Pair = (32.0, 20.0)  # of the disc at the first frame
    omega3_rad_s: float = math.nan  # spin about the axis; nan: that of a centre at rest
    nutation_deg: float = 0.05  # amplitude of the oscillation about regular precession
    nutation_phase_deg: float = 0.0
    state: dict[str, float] = field(default_factory=dict)  # components of rolling.State [SI] that replace the above
    struck: dict[str, float] = field(default_factory=dict)  # instead of the above: upright and at rest, hit by a ball;
    # lateral_mm, vertical_mm from the middle of the upper face, impulse_N_s, friction of the table during the impact
    effects: dict[str, dict[str, float]] = field(
        default_factory=lambda: {"km": {"k_m": 0.381e-7}, "kn": {"k_n": 0.381e-7}, "kz": {"k_z": 1e-5}}
    )
    # by names in rolling.CATALOGUE; a scene that names one replaces all, missing amounts are zero (effects_from_tables)
    formulas: dict[str, dict[str, str]] = field(default_factory=dict)  # laws of further effects: component -> formula


@dataclass(frozen=True)
class MotionSettings:
    """Source of the motion: poses (one frame each), a table over time, or the rolling model.

    Poses are rows of x, y, z [mm], psi, theta, phi [deg]; `table` is a CSV or NPY file next to the scene, with rows
    t [s], x, y, z [m], psi, theta, phi [rad] (interpolated by a cubic spline).
    """

    kind: str = "static"  # static, table or rolling
    poses: tuple[Pose, ...] = ((32.0, 20.0, 12.0, 30.0, 15.0, 40.0),)
    table: str = ""
    rolling: RollingMotion = field(default_factory=RollingMotion)


@dataclass(frozen=True)
class RenderSettings:
    """Accuracy and speed of the computation."""

    subpixels: int = limited(5, (2, MOST))  # cells per pixel and axis at an edge
    threads: int = limited(2, (1, MOST))
    png_compression: int = limited(3, (0, 9))  # 0 to 9


@dataclass(frozen=True)
class Scene:
    """Everything that determines a synthetic recording."""

    read_by: ClassVar[str] = "disctrack.synthetic.description:load_scene"

    name: str = "scene"
    seed: int = limited(1, (0, math.inf))
    gravity_m_s2: float = limited(9.81, POSITIVE)
    air_density_kg_m3: float = limited(AIR_DENSITY, POSITIVE)
    cameras: CameraSettings = field(default_factory=CameraSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    light: LightSettings = field(default_factory=LightSettings)
    appearance: AppearanceSettings = field(default_factory=AppearanceSettings)
    disc: DiscSettings = field(default_factory=DiscSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)
    board: BoardSettings = field(default_factory=BoardSettings)
    motion: MotionSettings = field(default_factory=MotionSettings, hash=False)  # it holds dictionaries
    faults: Faults = field(default_factory=Faults)
    imperfections: ImperfectionSettings = field(default_factory=ImperfectionSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    folder: Path = Path()  # to which file names in the scene are relative; set by load_scene

    @property
    def declared_disc(self) -> Disc:
        """The disc as declared in recording.toml."""
        dots = self.markers
        return disc_from_mm(**vars(self.disc), marker_centres_mm=dots.centres_mm, marker_diameter_mm=dots.diameter_mm)

    def changed(self, **values: object) -> "Scene":
        """Copy with other values; those of a section in a dictionary, as in the TOML file."""
        return _changed(self, values)


def _changed(settings: Any, values: object) -> Any:
    if not isinstance(values, dict) or isinstance(settings, dict):
        return values
    return replace(settings, **{key: _changed(getattr(settings, key), value) for key, value in values.items()})


def load_scene(path: str | Path) -> Scene:
    """Scene from a TOML file; missing keys have their defaults.

    Raises SceneError for a file that cannot be read, an unknown key (with the nearest known one) and an invalid value.
    """
    path = Path(path)
    return scene_from_tree(read_toml(path, SceneError), where=str(path), folder=path.parent)


def scene_from_tree(tree: dict[str, object], where: str = "scene", folder: Path = Path()) -> Scene:
    """Scene from nested dictionaries as returned by tomllib; errors as in `load_scene`."""
    scene = replace(build(Scene, tree, where), folder=folder)
    for bad, key, found, expected in _checks(scene):
        if bad:
            raise SceneError(f"{where}: {key} = {found}; expected {expected}")
    return scene


def scene_toml(scene: Scene) -> str:
    """Text of a TOML file from which `load_scene` restores the same scene, except for its folder."""
    return "\n".join(toml_lines(scene)).lstrip() + "\n"


def _checks(scene: Scene) -> Iterator[tuple[bool, str, object, str]]:
    """Whether a value is invalid, its key, the value, the expected one."""
    centres, hidden, misprints = scene.markers.centres_mm, scene.faults.hidden_markers, scene.faults.misprint_mm
    n = len(centres)
    reach_mm = max((math.hypot(x, y) for x, y in centres), default=0.0) + scene.markers.diameter_mm / 2
    yield n < 3, "markers.centres_mm", f"{n} rows", "3 or more"
    yield reach_mm > scene.disc.radius_mm, "markers.centres_mm", "a dot over the disc's rim", "dots on the face"
    yield len(misprints) not in (0, n), "faults.misprint_mm", f"{len(misprints)} rows", f"one per dot ({n})"
    yield any(not 0 <= k < n for k in hidden), "faults.hidden_markers", hidden, f"numbers from 0 to {n - 1}"
    cameras, hot, light = scene.cameras, scene.sensor.hot_pixels, scene.light.direction
    yield cameras.bit_depth not in (8, 10, 12, 16), "cameras.bit_depth", cameras.bit_depth, "8, 10, 12, 16"
    pixels = math.prod(cameras.image_size)
    yield hot > pixels, "sensor.hot_pixels", hot, f"no more than the {pixels} pixels of an image"
    yield not light[2] > 0, "light.direction", light, "a lamp above the table: the third above 0"
    low, high = scene.board.height_mm
    yield low > high, "board.height_mm", (low, high), "the lower, then the higher"
    kind = scene.motion.kind
    yield kind not in ("static", "table", "rolling"), "motion.kind", kind, "static, table, rolling"
    named = {g.camera for g in scene.light.glare} | {r.camera for r in scene.faults.occluders}
    yield not named <= {"left", "right"}, "camera of a glare or occluder", "another word", "left or right"
