"""Images of the disc and of the chessboard on the table, in both cameras."""

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from calibration.cameras.camera import Camera, StereoRig
from calibration.kit.types import Array, Array32
from disctrack.disc import Disc
from disctrack.faults.keys import Occluder
from disctrack.frames import CAMERAS, rotation_from_euler
from disctrack.synthetic import _raster_kernel as raster
from disctrack.synthetic import optics
from disctrack.synthetic.cameras import View, image_of, views_of
from disctrack.synthetic.description import Scene

PoseOverExposure = Callable[[Array], Array]  # (k,) times [s] from mid exposure -> (k, 6) q


class Stage:
    """One camera with everything in its image that does not move, computed once."""

    def __init__(self, index: int, view: View, scene: Scene) -> None:
        """Index : of the camera.   scene : its sections on motion and disc are not used"""
        sigma, size = scene.optics.blur_px[index], view.camera.image_size
        self.name, self.view, self.s = CAMERAS[index], view, scene.render.subpixels
        self.pad, self.weights = optics.blur_reach(sigma), optics.blur_weights(sigma, self.s)
        self.rays = optics.corner_rays(view.camera, self.pad, scene.imperfections.lens_field_px, (scene.seed, 9, index))
        self.cells = optics.table_cells(view, self.pad, self.s, scene)  # sharp table in the cells of the padded image
        # (height, width) blurred table, without lamp and vignetting
        self.table = optics.blur_to_pixels(self.cells, self.weights, self.s)
        self.factor, self.glare = optics.illumination(view, self.name, scene)
        self.pattern = optics.sensor_pattern(scene.imperfections, size, [scene.seed, 10, index])
        self.hot = optics.hot_pixels(scene.sensor, size, np.random.default_rng([scene.seed, 5, index]))

    def finish(self, irradiance: Array32) -> Array32:
        """Blurred image with lamp, vignetting and glare, and with the pattern and the hot pixels of the sensor."""
        return self.pattern(irradiance * self.factor + self.glare) + self.hot


def stages(rig: StereoRig, scene: Scene) -> tuple[Stage, ...]:
    """A stage for each camera; cached, so that calls with the same rig and appearance share the table."""
    sections = ("seed", "rig", "optics", "sensor", "light", "appearance", "imperfections", "render")
    look = Scene(**{name: getattr(scene, name) for name in sections})
    return tuple(
        _stage(index, view.camera, view.R_camera_world.tobytes(), view.t_camera_world.tobytes(), look)
        for index, view in enumerate(views_of(rig))
    )


@lru_cache(maxsize=4)
def _stage(index: int, camera: Camera, R: bytes, t: bytes, scene: Scene) -> Stage:
    return Stage(index, View(camera, np.frombuffer(R).reshape(3, 3), np.frombuffer(t)), scene)


def expected_disc_image(
    pose: PoseOverExposure, exposure: float, frame: int, stage: Stage, scene: Scene, disc: Disc
) -> Array32:
    """Expected grey values (height, width) of one exposure [s]; `pose` returns q around mid exposure.

    disc : the true one, with the dots at their true positions

    Light is integrated over the exposure by Gauss-Legendre quadrature, with at least one node per 0.8 px of motion. The
    mean and variance of the path are exact for two or more nodes.
    """
    nodes, weights = _exposure_rule(pose, exposure, stage, disc)
    q = pose(nodes * exposure)
    s, pad = stage.s, stage.pad
    width, height = stage.view.camera.image_size
    rods = [r for r in scene.faults.occluders if r.camera == stage.name and r.first_frame <= frame <= r.last_frame]
    around = _box(_outline(q, disc, stage.view), pad + 1, (0, 0), (width, height))
    x0, y0, x1, y1 = (0, 0, width, height) if rods else around
    image = stage.table.copy()
    if x0 < x1 and y0 < y1:
        # the window plus the radius of the blur on each side; padded coordinates start `pad` before the image
        table = stage.cells[y0 * s : (y1 + 2 * pad) * s, x0 * s : (x1 + 2 * pad) * s]
        body, face = np.zeros_like(table), np.zeros_like(table)  # coverage by the disc; grey of its face minus its side
        whole, rims = raster.body_shape(disc.radius, _top(disc)), _rims(disc.radius, _top(disc))
        for q_now, weight in zip(q, weights, strict=True):
            place = rotation_from_euler(*q_now[3:]), q_now[:3]
            _add(body, weight, stage, (x0, y0), place, whole, rims)
            for step, centre, radius in _face(stage, place, disc, scene):
                shape = raster.round_shape(centre[2], (centre[0], centre[1]), radius, disc.radius)
                _add(face, weight * step, stage, (x0, y0), place, shape, centre + radius * _RING)
        cells = table + body * (scene.appearance.side - table) + face
        for rod in rods:
            _draw_rod(cells, (y0 - pad, x0 - pad), s, rod)
        image[y0:y1, x0:x1] = optics.blur_to_pixels(cells, stage.weights, s)
    return stage.finish(image)


Place = tuple[Array, Array]  # R_world_body, t_world_body [m]


def _add(
    cells: Array32, step: float, stage: Stage, corner: tuple[int, int], place: Place, shape: Array, around: Array
) -> None:
    """Add a shape of a body to a window of the stage's padded cells.

    corner : x, y of the window's first pixel   around : (k, 3) points of the body that enclose the shape [m]
    """
    (R, t), view, s, (x, y) = place, stage.view, stage.s, corner
    end = x + cells.shape[1] // s, y + cells.shape[0] // s
    left, top, right, bottom = _box(image_of(around @ R.T + t, view) + stage.pad, 0, corner, end)
    if top < bottom and left < right:
        near = cells[(top - y) * s : (bottom - y) * s, (left - x) * s : (right - x) * s]
        rays = stage.rays[top : bottom + 1, left : right + 1]
        raster.add_shape(near, step, rays, view.R_camera_world @ R, R.T @ (view.centre - t), shape)


def _face(stage: Stage, place: Place, disc: Disc, scene: Scene) -> Iterator[tuple[float, Array, float]]:
    """Circles on the face that is visible to a camera: step of grey, centre in body axes, radius."""
    (R, t), look, top = place, scene.appearance, _top(disc)
    paper = np.array([*scene.faults.pattern_offset_mm, 1e3 * top]) * 1e-3
    height = float(R[:, 2] @ (stage.view.centre - t))
    light = optics.face_brightness(np.sign(height) * R[:, 2], scene)
    if height < -top:
        yield look.underside * light - look.side, np.array([0.0, 0.0, -top]), disc.radius
    if height > top:
        yield look.rim * light - look.side, np.array([0.0, 0.0, top]), disc.radius
        yield (look.paper - look.rim) * light, paper, disc.radius - 1e-3 * look.rim_width_mm
        for x, y, _ in disc.marker_centres_body:
            yield (look.dot - look.paper) * light, np.array([x, y, top]), disc.marker_diameter / 2


def _top(disc: Disc) -> float:
    """Height of the dots over the centre of the disc [m]: half the thickness plus that of the paper."""
    return float(disc.marker_centres_body[:, 2].mean() if disc.n_markers else disc.half_thickness)


def _exposure_rule(pose: PoseOverExposure, exposure: float, stage: Stage, disc: Disc) -> tuple[Array, Array]:
    """Quadrature nodes in units of the exposure, from -1/2 to 1/2, and weights with the sum 1."""
    outline = _outline(pose(np.array([-0.5, 0.5]) * exposure), disc, stage.view)
    path_px = float(np.max(np.linalg.norm(outline[1] - outline[0], axis=-1)))
    # one node if the path is below 0.02 px: its variance, path^2 / 12, is 5e-5 of that of the blur
    nodes, weights = np.polynomial.legendre.leggauss(1 if path_px < 0.02 else 2 + int(path_px / 0.8))
    return nodes / 2, weights / 2


_RING = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.radians(np.arange(0, 360, 10))])


def _rims(radius: float, half_thickness: float) -> Array:
    """(72, 3) points on both rims."""
    return np.concatenate([radius * _RING + [0.0, 0.0, z] for z in (half_thickness, -half_thickness)])


def _outline(q: Array, disc: Disc, view: View) -> Array:
    """Pixels (k, 72, 2) of points on both rims at poses q (k, 6)."""
    rims = _rims(disc.radius, disc.half_thickness)
    return image_of(rims @ np.swapaxes(rotation_from_euler(*q[:, 3:].T), -1, -2) + q[:, None, :3], view)


def _box(outline: Array, margin: int, begin: tuple[int, int], end: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the pixels around an outline, between the corners `begin` and `end` of a window."""
    pixels = outline.reshape(-1, 2)
    low = np.floor(pixels.min(axis=0)).astype(int) - margin - 2  # margin for the arcs between the points
    high = np.ceil(pixels.max(axis=0)).astype(int) + margin + 3
    return max(low[0], begin[0]), max(low[1], begin[1]), min(high[0], end[0]), min(high[1], end[1])


def _draw_rod(cells: Array32, corner: tuple[int, int], s: int, rod: Occluder) -> None:
    """Draw a straight rod over the cells, with edges that are linear over one cell."""
    y = (np.arange(cells.shape[0]) + 0.5) / s - 0.5 + corner[0] - rod.centre_px[1]
    x = (np.arange(cells.shape[1]) + 0.5) / s - 0.5 + corner[1] - rod.centre_px[0]
    c, n = np.cos(np.radians(rod.angle_deg)), np.sin(np.radians(rod.angle_deg))
    along, across = c * x + n * y[:, None], -n * x + c * y[:, None]
    area = np.clip((rod.width_px / 2 - np.abs(across)) * s + 0.5, 0, 1)
    area *= np.clip((rod.length_px / 2 - np.abs(along)) * s + 0.5, 0, 1)
    cells += (area * (rod.grey - cells)).astype(np.float32)


def expected_board_image(R_world_board: Array, t_world_board: Array, stage: Stage, scene: Scene) -> Array32:
    """Expected grey values (height, width) of the chessboard at rest in one camera."""
    board, look = scene.board, scene.appearance
    light = optics.face_brightness(R_world_board[:, 2], scene)
    square, margin = board.square_mm * 1e-3, board.margin_mm * 1e-3
    columns, rows = board.inner_corners
    bow, stretch = scene.imperfections.board_bow_mm * 1e-3, 1 + scene.imperfections.board_stretch
    middle, half = 0.5 * (columns - 1) * square, 0.5 * (columns + 1) * square

    def add(cells: Array32, step: float, x: tuple[float, float], y: tuple[float, float]) -> None:
        x = x[0] * stretch, x[1] * stretch
        around = np.array([[a, b, bow * (1 - ((a - middle) / half) ** 2)] for a in (*x, middle) for b in y])
        shape = raster.sheet_shape(x, y, (bow, middle, half))
        _add(cells, step, stage, (0, 0), (R_world_board, t_world_board), shape, around)

    sheet, squares = np.zeros_like(stage.cells), np.zeros_like(stage.cells)
    add(sheet, 1.0, (-square - margin, columns * square + margin), (-square - margin, rows * square + margin))
    for i in range(-1, columns):
        for j in range(-1, rows):
            if (i + j) % 2 == 0:
                step = (look.board_black - look.board_white) * light
                add(squares, step, (i * square, (i + 1) * square), (j * square, (j + 1) * square))
    cells = stage.cells + sheet * (look.board_white * light - stage.cells) + squares
    return stage.finish(optics.blur_to_pixels(cells, stage.weights, stage.s))
