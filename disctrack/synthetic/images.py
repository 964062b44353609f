"""Images of the disc and of the chessboard before the table, as the pair of cameras takes them."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.cameras.camera import Camera, StereoRig
from calibration.kit.arrays import Array, Array32, Mask
from disctrack.disc import Disc
from disctrack.faults.keys import Occluder
from disctrack.frames import rotation_from_euler
from disctrack.synthetic import imperfect, optics
from disctrack.synthetic.board_raster import draw_board
from disctrack.synthetic.cameras import View, image_of
from disctrack.synthetic.description import (
    AppearanceSettings,
    ImperfectionSettings,
    LightSettings,
    OpticsSettings,
    Scene,
    SensorSettings,
)
from disctrack.synthetic.disc_raster import draw_disc
from disctrack.synthetic.rays import corner_rays
from disctrack.synthetic.sensor import digitise, hot_pixels

PoseOverExposure = Callable[[Array], Array]  # (k,) times [s] from mid exposure -> (k, 6) q


@dataclass(frozen=True)
class Stage:
    """One camera and all that stands still before it, computed once."""

    name: str
    view: View
    s: int
    pad: int
    weights: Array32
    rays: Array
    cells: Array32  # table in the cells of the padded image
    table: Array32  # (height, width) blurred table, before lamp and vignetting
    factor: Array32
    glare: Array32
    pattern: imperfect.Pattern | None
    hot: Array32 | None

    def finish(self, irradiance: Array32) -> Array32:
        """Lamp, vignetting and glare on a blurred image, as a sensor with its pattern has it."""
        grey = irradiance * self.factor + self.glare
        return grey if self.pattern is None else self.pattern.seen(grey)


def stages(rig: StereoRig, scene: Scene) -> tuple[Stage, Stage]:
    """Left and right stage; cached, so that calls with the same rig and look share the table."""
    look = (
        scene.seed, scene.appearance, scene.optics, scene.light, scene.sensor, scene.imperfections, scene.rig.target_mm,
    )  # fmt: skip
    left, right = (
        _stage(name, camera, R.tobytes(), t.tobytes(), *look, scene.render.subpixels)
        for name, camera, (R, t) in zip(("left", "right"), rig.cameras, rig.camera_poses(), strict=True)
    )
    return left, right


@lru_cache(maxsize=4)
def _stage(
    name: str,
    camera: Camera,
    R: bytes,
    t: bytes,
    seed: int,
    appearance: AppearanceSettings,
    optics_settings: OpticsSettings,
    light: LightSettings,
    sensor: SensorSettings,
    imperfections: ImperfectionSettings,
    target_mm: tuple[float, float, float],
    s: int,
) -> Stage:
    scene = Scene(seed=seed, appearance=appearance, optics=optics_settings, light=light, sensor=sensor)
    scene = replace(scene, rig=replace(scene.rig, target_mm=target_mm))
    view = View(camera, np.frombuffer(R).reshape(3, 3), np.frombuffer(t))
    index = ("left", "right").index(name)
    sigma = optics_settings.blur_px[index]
    pad, weights = optics.blur_reach(sigma), optics.blur_weights(sigma, s)
    cells = optics.table_cells(view, pad, s, scene)
    factor, glare = optics.illumination(view, name, scene)
    return Stage(
        name=name,
        view=view,
        s=s,
        pad=pad,
        weights=weights,
        rays=imperfect.lens_rays(corner_rays(camera, pad), pad, camera, imperfections, [seed, 9, index]),
        cells=cells,
        table=optics.blur_to_pixels(cells, weights, s),
        factor=factor,
        glare=glare,
        pattern=imperfect.sensor_pattern(imperfections, camera.image_size, [seed, 10, index]),
        hot=hot_pixels(sensor, camera.image_size, np.random.default_rng([seed, 5, index])),
    )


@dataclass(frozen=True)
class TrueDisc:
    """The disc as it is, whatever a recording declares: `disc` carries the true centres of the dots."""

    disc: Disc
    paper_centre_body: tuple[float, float] = (0.0, 0.0)  # [m]


def expected_disc_image(
    pose: PoseOverExposure,
    exposure: float,
    stage: Stage,
    true_disc: TrueDisc,
    scene: Scene,
    visible: Mask | None = None,
    occluders: Iterable[Occluder] = (),
) -> Array32:
    """Expected grey values (height, width) of one exposure [s]; `pose` gives q around mid exposure.

    Light is gathered at the nodes of a Gauss-Legendre rule over the exposure, at least one node per 0.8 px of motion:
    the mean and the variance of the path are exact from two nodes on.
    """
    nodes, weights = _exposure_rule(pose, exposure, stage, true_disc.disc)
    q = pose(nodes * exposure)
    R_world_body = rotation_from_euler(q[:, 3], q[:, 4], q[:, 5])
    view, s, pad = stage.view, stage.s, stage.pad
    width, height = view.camera.image_size
    occluders = tuple(occluders)
    outline = _outline(q, R_world_body, true_disc.disc, view)
    x0, y0, x1, y1 = _window(outline, pad + 1, width, height) if not occluders else (0, 0, width, height)
    image = stage.table.copy()
    if x0 < x1 and y0 < y1:
        # the window in cells, with the reach of the blur on each side; padded coordinates start `pad` before the image
        box = (slice(y0 * s, (y1 + 2 * pad) * s), slice(x0 * s, (x1 + 2 * pad) * s))
        background = np.ascontiguousarray(stage.cells[box])
        cells = np.zeros_like(background)
        disc = true_disc.disc
        dots = disc.marker_centres_body[:, :2] if visible is None else disc.marker_centres_body[visible, :2]
        paper = np.array([*true_disc.paper_centre_body, disc.radius - scene.appearance.rim_width_mm * 1e-3])
        top = float(disc.marker_centres_body[:, 2].mean())  # half the thickness, unless the paper lies higher
        for R, centre, weight in zip(R_world_body, q[:, :3], weights, strict=True):
            draw_disc(
                cells, background, (y0, x0), stage.rays, s, weight,
                np.ascontiguousarray(view.R_camera_world @ R), view.R_camera_world @ centre + view.t_camera_world,
                disc.radius, top, paper, np.ascontiguousarray(dots), disc.marker_diameter / 2,
                _surface_greys(R, scene),
            )  # fmt: skip
        for rod in occluders:
            _draw_rod(cells, (y0 - pad, x0 - pad), s, rod)
        image[y0:y1, x0:x1] = optics.blur_to_pixels(cells, stage.weights, s)
    return stage.finish(image)


def _surface_greys(R_world_body: Array, scene: Scene) -> Array:
    look = scene.appearance
    face = optics.face_brightness(R_world_body[:, 2], scene)
    under = optics.face_brightness(-R_world_body[:, 2], scene)
    return np.array([look.paper * face, look.dot * face, look.rim * face, look.side, look.underside * under])


def _exposure_rule(pose: PoseOverExposure, exposure: float, stage: Stage, disc: Disc) -> tuple[Array, Array]:
    """Nodes in units of the exposure (from -1/2 to 1/2) and weights of sum 1."""
    if exposure == 0:
        return np.zeros(1), np.ones(1)
    q = pose(np.array([-0.5, 0.5]) * exposure)
    outline = _outline(q, rotation_from_euler(q[:, 3], q[:, 4], q[:, 5]), disc, stage.view).reshape(2, -1, 2)
    path_px = float(np.max(np.linalg.norm(outline[1] - outline[0], axis=-1)))
    if path_px < 0.02:  # its variance, path^2 / 12, is 5e-5 of the blur's
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(2 + int(path_px / 0.8))
    return nodes / 2, weights / 2


_RING = np.radians(np.arange(0, 360, 10))


def _outline(q: Array, R_world_body: Array, disc: Disc, view: View) -> Array:
    """Pixels (k * 72, 2) of points on both rims."""
    ring = np.column_stack([np.cos(_RING), np.sin(_RING)]) * disc.radius
    rims = np.concatenate(
        [np.column_stack([ring, np.full(len(ring), z)]) for z in (disc.half_thickness, -disc.half_thickness)]
    )
    points = rims @ np.swapaxes(R_world_body, -1, -2) + q[:, None, :3]
    return image_of(points, view).reshape(-1, 2)


def _window(outline: Array, margin: int, width: int, height: int) -> tuple[int, int, int, int]:
    low = np.floor(outline.min(axis=0)).astype(int) - margin - 2  # 2: the arcs between the points
    high = np.ceil(outline.max(axis=0)).astype(int) + margin + 3
    return max(low[0], 0), max(low[1], 0), min(high[0], width), min(high[1], height)


def _draw_rod(cells: Array32, corner: tuple[int, int], s: int, rod: Occluder) -> None:
    """Lay a straight rod over the cells; its edges are linear over one cell."""
    y = (np.arange(cells.shape[0]) + 0.5) / s - 0.5 + corner[0] - rod.centre_px[1]
    x = (np.arange(cells.shape[1]) + 0.5) / s - 0.5 + corner[1] - rod.centre_px[0]
    c, n = np.cos(np.radians(rod.angle_deg)), np.sin(np.radians(rod.angle_deg))
    along, across = c * x + n * y[:, None], -n * x + c * y[:, None]
    area = np.clip((rod.width_px / 2 - np.abs(across)) * s + 0.5, 0, 1)
    area *= np.clip((rod.length_px / 2 - np.abs(along)) * s + 0.5, 0, 1)
    cells += (area * (rod.grey - cells)).astype(np.float32)


def expected_disc(
    q: ArrayLike,
    rig: StereoRig,
    disc: Disc,
    scene: Scene | None = None,
    *,
    qdot: ArrayLike | None = None,
    visible: ArrayLike | None = None,
    paper_centre_body: tuple[float, float] = (0.0, 0.0),
) -> Array32:
    """Noise-free grey values (n, 2 cameras, height, width) before quantisation; arguments as for `render_disc`."""
    return _disc_series(q, rig, disc, scene or Scene(), qdot, visible, paper_centre_body, lambda image, _: image)


def render_disc(
    q: ArrayLike,
    rig: StereoRig,
    disc: Disc,
    scene: Scene | None = None,
    rng: np.random.Generator | None = None,
    *,
    qdot: ArrayLike | None = None,
    visible: ArrayLike | None = None,
    paper_centre_body: tuple[float, float] = (0.0, 0.0),
) -> NDArray[Any]:
    """Images (n, 2 cameras, height, width) of the disc at the poses q: uint8, or uint16 for more than 8 bits.

    q       : (n, 6) at mid exposure, SI and radians (frames.py); (6,) counts as n = 1
    rig     : the true cameras; disc: the true disc, its marker centres those that are printed
    scene   : appearance, optics, light, sensor, exposure; defaults of `Scene`. Its `disc`, `rig`, `motion` and `faults`
              (but for the occluders) are not used here
    rng     : noise; None: no noise, only quantisation
    qdot    : (n, 6) rates; the pose moves with them for the exposure time. None: at rest
    visible : (n, 2, m) or what broadcasts to it; False: that dot is missing on the paper
    """
    settings = scene or Scene()
    q = np.atleast_2d(np.asarray(q, float))
    noise = [None] * (2 * len(q)) if rng is None else rng.spawn(2 * len(q))
    hot = [stage.hot for stage in stages(rig, settings)]

    def expose(image: Array32, index: int) -> NDArray[Any]:
        return digitise(image, settings.sensor, settings.cameras.bit_depth, noise[index], hot[index % 2])

    return _disc_series(q, rig, disc, settings, qdot, visible, paper_centre_body, expose)


def _disc_series(
    q: ArrayLike,
    rig: StereoRig,
    disc: Disc,
    scene: Scene,
    qdot: ArrayLike | None,
    visible: ArrayLike | None,
    paper_centre_body: tuple[float, float],
    finish: Callable[[Array32, int], NDArray[Any]],
) -> NDArray[Any]:
    q = np.atleast_2d(np.asarray(q, float))
    rates = np.zeros_like(q) if qdot is None else np.broadcast_to(np.asarray(qdot, float), q.shape)
    seen = np.broadcast_to(True if visible is None else np.asarray(visible, bool), (len(q), 2, disc.n_markers))
    both = stages(rig, scene)
    true_disc = TrueDisc(disc, paper_centre_body)
    exposure = 0.0 if qdot is None else scene.cameras.exposure_s

    def one(index: int) -> NDArray[Any]:
        i, c = divmod(index, 2)
        rods = [r for r in scene.faults.occluders if r.camera == both[c].name and r.first_frame <= i <= r.last_frame]
        image = expected_disc_image(
            lambda dt: q[i] + dt[:, None] * rates[i], exposure, both[c], true_disc, scene, seen[i, c], rods
        )
        return finish(image, index)

    return _gather(one, len(q), scene)


def render_board(
    R_world_board: ArrayLike,
    t_world_board: ArrayLike,
    rig: StereoRig,
    scene: Scene | None = None,
    rng: np.random.Generator | None = None,
) -> NDArray[Any]:
    """Images (n, 2 cameras, height, width) of the chessboard of `scene.board` in n poses, as `render_disc`.

    R_world_board (n, 3, 3), t_world_board (n, 3) [m]: the board's origin is the lower left inner corner seen with the
    side of dark corner squares on the left, its axes run along the long side, the short side and out of the print.
    """
    settings = scene or Scene()
    R, t = np.asarray(R_world_board, float).reshape(-1, 3, 3), np.asarray(t_world_board, float).reshape(-1, 3)
    noise = [None] * (2 * len(R)) if rng is None else rng.spawn(2 * len(R))
    both = stages(rig, settings)

    def one(index: int) -> NDArray[Any]:
        i, c = divmod(index, 2)
        image = expected_board_image(R[i], t[i], both[c], settings)
        return digitise(image, settings.sensor, settings.cameras.bit_depth, noise[index], both[c].hot)

    return _gather(one, len(R), settings)


def expected_board_image(R_world_board: Array, t_world_board: Array, stage: Stage, scene: Scene) -> Array32:
    """Expected grey values (height, width) of the chessboard at rest in one camera."""
    view, board = stage.view, scene.board
    cells = np.zeros_like(stage.cells)
    light = optics.face_brightness(R_world_board[:, 2], scene)
    draw_board(
        cells, stage.cells, stage.rays, stage.s,
        np.ascontiguousarray(view.R_camera_world @ R_world_board),
        view.R_camera_world @ t_world_board + view.t_camera_world,
        board.square_mm * 1e-3, board.inner_corners[0], board.inner_corners[1], board.margin_mm / board.square_mm,
        scene.appearance.board_white * light, scene.appearance.board_black * light,
        imperfect.bent_board(scene.imperfections, board),
    )  # fmt: skip
    return stage.finish(optics.blur_to_pixels(cells, stage.weights, stage.s))


def _gather(one: Callable[[int], NDArray[Any]], n: int, scene: Scene) -> NDArray[Any]:
    """Images one(0 ... 2 n - 1) as (n, 2, height, width), on the scene's threads."""
    with ThreadPoolExecutor(max_workers=max(scene.render.threads, 1)) as pool:
        images = list(pool.map(one, range(2 * n)))
    return np.stack(images).reshape(n, 2, *images[0].shape)
