"""Recordings as an ordinary laboratory makes them, by ray casting that has no part in the product's renderer.

Every imperfection has its own switch: a lens with a smooth residual field beyond any radial polynomial, a chessboard
that is bowed and stretched along one side, pixel gains, column offsets, a curved response, light that falls off, a
broad glare. The motion is that of `newton_euler`. Images are cast backwards through each camera on a grid of SUB x SUB
rays per pixel, blurred there, and gathered to pixels.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.oracles import newton_euler

SUB = 4  # rays per pixel and axis
RADIUS, HALF_THICKNESS, MASS, G = 37.5e-3, 3e-3, 0.20969, 9.81
DOT_RADIUS = 3.5e-3
ANGLES = np.radians([0, 60, 120, 180, 240, 300])
DOTS = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]) * np.array([26, 26, 26, 26, 26, 13.0])[:, None] * 1e-3
BOARD_THICKNESS = 3e-3
GAUSS = ((-0.7745966692414834, 5 / 18), (0.0, 8 / 18), (0.7745966692414834, 5 / 18))

# What hides in the motion: laws and changes of the body that newton_euler follows.
EFFECTS = {
    "none": ((), {}),
    "tilt": ((), {"gravity": (G * np.sin(np.radians(0.1)), 0.0, -G * np.cos(np.radians(0.1)))}),
    "kz": ((newton_euler.pivoting_friction(30e-6),), {}),
    "com": ((), {"com_body": (50e-6, 0.0, 0.0)}),
    "rolling": ((newton_euler.classical_rolling_friction(30e-6),), {}),
    "drag": ((lambda disc, now: (-2.5e-6 * now.omega, newton_euler.ZERO, newton_euler.ZERO),), {}),
}


@dataclass(frozen=True)
class Imperfections:
    """How much of each; 0 switches it off."""

    lens_field: float = 0.02  # [px] rms per axis
    bow: float = 60e-6  # [m] of the board, middle against short sides
    stretch: float = 2e-4  # squares longer along the long side
    gains: float = 0.01  # rms of the pixels' gains
    columns: float = 0.3  # [grey] rms of the columns' offsets
    curve: float = 0.03  # largest departure of the response from a straight line, of full scale
    fall_off: float = 0.15  # of the light, from the brightest place to the farthest corner
    glare: float = 12.0  # [grey]
    misprint: float = 0.0  # [m] rms of the dots' places, per axis
    exposure: float = 2e-4  # [s]


IDEAL = Imperfections(**{f.name: 0.0 for f in fields(Imperfections)})


@dataclass(frozen=True)
class Trouble:
    """What goes wrong with sensor and light in single recordings; nothing by default."""

    contrast: float = 1.0  # of the scene, about a middle grey: 0.24 leaves 40 grey values between ink and paper
    stuck_pixels: int = 0  # of each camera that show full scale, and as many that show nothing
    flicker: float = 0.0  # of the light, 100 Hz, amplitude over mean
    hand: range = range(0)  # frames in which a hand hides half of the disc
    glare: range = range(0)  # frames in which saturated glare lies on one dot
    glare_dot: int = 2

    def before(self, camera, radiance, poses, dots, frame, frame_rate):
        """The scene's light as it reaches the sensor."""
        radiance = 110 + self.contrast * (radiance - 110)
        R, t, _ = poses[len(poses) // 2]
        y, x = np.mgrid[: camera.size, : camera.size]
        if frame in self.hand:
            centre = camera.project(t[None])[0]
            edge = 12 * np.sin(0.1 * y + 0.3 * frame)  # fingers that move
            hand = np.clip(x - centre[0] + edge, 0, 1)
            radiance = radiance + hand * (120 + 10 * np.sin(0.07 * x) - radiance)
        if frame in self.glare:
            u, v = camera.project((np.append(dots[self.glare_dot], HALF_THICKNESS) @ R.T + t)[None])[0]
            radiance = radiance + 900 * np.exp(-0.5 * ((x - u - 3) ** 2 + (y - v + 2) ** 2) / 6.0**2)
        return radiance * (1 + self.flicker * np.sin(2 * np.pi * 100 * frame / frame_rate + 0.4))

    def after(self, camera, image):
        """The image with its stuck pixels."""
        if self.stuck_pixels:
            where = np.random.default_rng(int(1e3 * camera.focal)).permutation(image.size)[: 2 * self.stuck_pixels]
            image = image.copy()
            image.flat[where[::2]], image.flat[where[1::2]] = 255, 0
        return image


@dataclass(frozen=True)
class Plan:
    """A recording."""

    seed: int = 1
    n_frames: int = 300
    size: int = 512
    mm_per_px: float = 0.25
    n_views: int = 20
    azimuths: tuple[float, float] = (-122.0, -53.0)  # [deg] of the cameras
    inner_corners: tuple[int, int] = (9, 6)
    square: float = 8e-3
    theta_deg: float = 12.0
    omega3: float = 1.5
    frame_rate: float = 1000.0
    effect: str = "none"
    imperfections: Imperfections = Imperfections()
    paper: float = 190.0
    ink: float = 25.0
    blur: float = 0.62  # [px]
    trouble: Trouble = Trouble()
    board_heights: tuple = (5e-3, 40e-3)  # [m] of the board's middle over the target

    @property
    def board_size(self):
        """[m] of the board from the first to the last corner, along both sides."""
        return self.square * (np.array(self.inner_corners) - 1)


def cameras_of(plan, rng):
    """The two cameras, and the place that they look at."""
    target = np.array([0.032, 0.02, 0.004]) + rng.normal(0, 5e-4, 3)
    return [Camera(rng, plan, azimuth, target) for azimuth in plan.azimuths], target


class Camera:
    """Pinhole, two radial terms and the residual field; rays of every sub-pixel, and a fixed pattern of the sensor."""

    def __init__(self, rng, plan, azimuth, target):
        faults, size = plan.imperfections, plan.size
        self.size = size
        off, azimuth = np.radians(42 + rng.normal(0, 2)), np.radians(azimuth + rng.normal(0, 2))
        distance = 0.42 + rng.normal(0, 0.01)
        self.focal = distance / (plan.mm_per_px * 1e-3) * (1 + rng.normal(0, 0.005))
        self.middle = (size - 1) / 2 + rng.normal(0, 4, 2)
        self.k1, self.k2 = -0.11 + rng.normal(0, 0.01), 0.22
        back = np.array([np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), np.cos(off)])
        z = -back
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        roll = np.radians(rng.normal(0, 2))
        y = np.cross(z, x)
        self.R = np.array([np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, z])
        self.place = target + distance * back
        self.waves = rng.normal(size=(6, 2)) * 2 * np.pi / (0.9 * size)  # wavelengths of about the image's side
        self.phases = rng.uniform(0, 2 * np.pi, (6, 2))
        grid = np.stack(np.meshgrid(np.arange(0, size, 8.0), np.arange(0, size, 8.0)), -1)
        raw = self._raw_field(grid)
        self.field_mean, self.field_scale = raw.mean((0, 1)), faults.lens_field / raw.std((0, 1))
        self.gain = 1 + faults.gains * rng.normal(size=(size, size))
        self.offset = faults.columns * rng.normal(size=size)
        u = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1) / size - 0.5
        far = np.sum((u - rng.uniform(-0.25, 0.25, 2)) ** 2, -1)
        self.light = 1 - faults.fall_off * far / far.max()
        glow = np.sum((u - rng.uniform(-0.25, 0.25, 2)) ** 2, -1)
        self.glare = faults.glare * np.exp(-0.5 * glow / 0.18**2)
        texture = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), 6.0)
        self.table = 85 + 2 * texture / texture.std()
        self.curve = faults.curve

    @cached_property
    def rays(self):
        """(size SUB, size SUB, 2) of the sub-pixels: only images need them."""
        fine = (np.arange(self.size * SUB) + 0.5) / SUB - 0.5
        return self.slopes(np.stack(np.meshgrid(fine, fine), -1))

    @cached_property
    def coarse(self):
        """(size, size, 2) of the pixels."""
        return self.slopes(np.stack(np.meshgrid(np.arange(self.size), np.arange(self.size)), -1).astype(float))

    def _raw_field(self, pixels):
        turns = np.einsum("...j,kj->...k", pixels, self.waves)
        return np.stack([np.sin(turns + self.phases[:, axis]).sum(-1) for axis in (0, 1)], -1)

    def field(self, pixels):
        """Displacement [px] of an image point at these pixels (..., 2) from where the polynomial has it."""
        return (self._raw_field(pixels) - self.field_mean) * self.field_scale

    def slopes(self, pixels):
        """Directions (..., 2) of the rays of pixels (..., 2): x and y where z is 1."""
        smooth = pixels - self.field(pixels)
        distorted = (smooth - self.middle) / self.focal
        ray = distorted.copy()
        for _ in range(12):
            r2 = np.sum(ray * ray, -1, keepdims=True)
            ray = distorted / (1 + r2 * (self.k1 + r2 * self.k2))
        return ray

    def project(self, points):
        """Pixels (..., 2) of world points (..., 3)."""
        inside = (points - self.place) @ self.R.T
        ray = inside[..., :2] / inside[..., 2:]
        r2 = np.sum(ray * ray, -1, keepdims=True)
        smooth = self.middle + self.focal * ray * (1 + r2 * (self.k1 + r2 * self.k2))
        found = smooth
        for _ in range(4):
            found = smooth + self.field(found)
        return found

    def plane(self, rays, R, t, height):
        """Where rays (..., 2) meet z = height (one, or one a ray) of a body at R, t: two arrays of body coordinates."""
        o = R.T @ (self.place - t)
        M = R.T @ self.R.T
        d = [rays[..., 0] * M[i, 0] + rays[..., 1] * M[i, 1] + M[i, 2] for i in range(3)]
        s = (height - o[2]) / d[2]
        return o[0] + s * d[0], o[1] + s * d[1]

    def expose(self, radiance, rng):
        """Grey values (uint8) from ideal ones: light, glare, response, pattern, noise."""
        grey = radiance * self.light + self.glare
        part = grey / 255
        grey = 255 * (part + 4 * self.curve * part * (1 - part))
        grey = grey * self.gain + self.offset
        grey = grey + rng.normal(size=grey.shape) * np.sqrt(0.64 + np.maximum(grey, 0) / 50)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def gathered(fine, blur):
    """Sub-pixel values blurred by the lens and averaged over pixels."""
    soft = cv2.GaussianBlur(fine, (0, 0), blur * SUB, borderType=cv2.BORDER_REPLICATE)
    h, w = soft.shape
    return soft.reshape(h // SUB, SUB, w // SUB, SUB).mean((1, 3))


def board_image(camera, plan, R, t, rng):
    """One view of the board; R, t of the board's frame: origin at corner 0 of the printed face's undeformed plane."""
    faults, a = plan.imperfections, plan.square
    long, short = plan.board_size
    x, y = camera.plane(camera.rays, R, t, 0.0)
    for _ in range(3):
        x, y = camera.plane(camera.rays, R, t, board_height(x / (1 + faults.stretch), plan))
    x = x / (1 + faults.stretch)
    w = plan.mm_per_px * 1e-3 / SUB  # of a sub-pixel on the board, near enough for the antialiasing

    def side(v):
        cell = v / a
        near, spans = np.rint(cell), np.hypot(*np.gradient(cell))  # of a sub-pixel, wider where the board is slanted
        return np.clip(2 * (cell - near) / spans, -1, 1) * np.where(near % 2 == 0, 1, -1)

    black = 0.5 + 0.5 * side(x) * side(y)
    beyond = np.maximum(np.maximum(-a - x, x - long - a), np.maximum(-a - y, y - short - a))
    black = black * np.clip(0.5 - beyond / w, 0, 1)
    on_board = np.clip(0.5 - (beyond - a) / w, 0, 1)
    table = cv2.resize(camera.table, None, fx=SUB, fy=SUB, interpolation=cv2.INTER_LINEAR)
    radiance = table + on_board * (200 - 180 * black - table)
    return camera.expose(gathered(radiance, plan.blur), rng)


def board_height(x, plan):
    """Height [m] of the printed face above its lowest part, at x [m] along the long side."""
    bow, half = plan.imperfections.bow, 0.5 * plan.board_size[0]
    along = (x - half) / (half + plan.square)
    return bow * (1 - along**2) if plan.seed % 2 else bow * along**2


def board_pose(view, plan, target, rng):
    """R, t of the printed face; the first view is that of the board on the table."""
    if not view:
        return np.eye(3), np.array([0.0, 0.0, BOARD_THICKNESS])
    azimuth = rng.uniform(0, 2 * np.pi)
    R = cv2.Rodrigues(rng.uniform(0, np.radians(38)) * np.array([np.cos(azimuth), np.sin(azimuth), 0]))[0]
    R = R @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-1, 1) * np.radians(35)]))[0]
    place = target + np.array([*rng.uniform(-0.022, 0.022, 2), rng.uniform(*plan.board_heights)])
    return R, place - R @ np.array([*(0.5 * plan.board_size), 0.0])


def disc_image(camera, plan, poses, dots, rng, frame=0):
    """One image; poses: (R, t, weight) over the exposure, in the order of time."""
    size, soft = plan.size, camera.table.copy()
    R, t, _ = poses[len(poses) // 2]
    rim = np.column_stack([np.cos(np.linspace(0, 6.3, 40)), np.sin(np.linspace(0, 6.3, 40))]) * RADIUS
    faces = np.concatenate([np.column_stack([rim, np.full(40, h)]) for h in (HALF_THICKNESS, -HALF_THICKNESS)])
    outline = camera.project(faces @ R.T + t)
    x0, y0 = np.clip(np.floor(outline.min(0)).astype(int) - 4, 0, size - 1)
    x1, y1 = np.clip(np.ceil(outline.max(0)).astype(int) + 5, 1, size)
    box = np.s_[y0:y1, x0:x1]
    px = plan.mm_per_px * 1e-3
    for height in np.linspace(-HALF_THICKNESS, HALF_THICKNESS, 5):
        x, y = camera.plane(camera.coarse[box], R, t, height)
        rho = np.hypot(x, y)
        inside = np.clip(0.5 - (rho - RADIUS) / px, 0, 1)
        soft[box] += inside * (58 - soft[box])
    soft[box] += inside * (118 - soft[box])
    soft[box] += np.clip(0.5 - (rho - RADIUS + 1.5e-3) / px, 0, 1) * (plan.paper - soft[box])
    soft = cv2.GaussianBlur(soft, (0, 0), np.hypot(plan.blur, 0.29))
    circle = np.column_stack([np.cos(np.linspace(0, 6.3, 24)), np.sin(np.linspace(0, 6.3, 24))]) * DOT_RADIUS
    margin = int(np.ceil(4 * plan.blur + 2))
    for dot in dots:
        ring = np.column_stack([dot + circle, np.full(24, HALF_THICKNESS)])
        edge = np.concatenate([camera.project(ring @ Rk.T + tk) for Rk, tk, _ in poses])
        x0, y0 = np.floor(edge.min(0)).astype(int) - margin
        x1, y1 = np.ceil(edge.max(0)).astype(int) + margin + 1
        if min(x0, y0) < 0 or max(x1, y1) > size:
            continue
        rays = camera.rays[y0 * SUB : y1 * SUB, x0 * SUB : x1 * SUB]
        cover = 0.0
        for Rk, tk, weight in poses:
            x, y = camera.plane(rays, Rk, tk, HALF_THICKNESS)
            x, y = x - dot[0], y - dot[1]
            h, w = x.shape
            i, j = h // 2, w // 2  # one linear map from sub-pixels to the face will do for the width of the edge
            G = np.array(
                [[x[i, j + 1] - x[i, j], x[i + 1, j] - x[i, j]], [y[i, j + 1] - y[i, j], y[i + 1, j] - y[i, j]]]
            )
            rho = np.hypot(x, y) + 1e-12
            step = np.hypot(G[0, 0] * x + G[1, 0] * y, G[0, 1] * x + G[1, 1] * y) / rho
            cover = cover + weight * np.clip(0.5 - (rho - DOT_RADIUS) / step, 0, 1)
        soft[y0:y1, x0:x1] += gathered(cover, plan.blur) * (plan.ink - soft[y0:y1, x0:x1])
    soft = plan.trouble.before(camera, soft, poses, dots, frame, plan.frame_rate)
    return plan.trouble.after(camera, camera.expose(soft, rng))


def motion(plan):
    """Spline of (x, y, z, psi, theta, phi) over time."""
    laws, changes = EFFECTS[plan.effect]
    body, duration = newton_euler.of_the_paper(*laws, **changes), plan.n_frames / plan.frame_rate
    return newton_euler.filmed_motion(
        body, plan.theta_deg, plan.omega3, duration, plan.frame_rate, psi=0.7 + 1.9 * plan.seed
    )


def pose_of(q):
    """R (..., 3, 3), t (..., 3) of the disc at q (..., 6)."""
    return Rotation.from_euler("ZXZ", q[..., 3:]).as_matrix(), q[..., :3]


def poses_during(spline, time, exposure):
    """(R, t, weight) of the disc over an exposure about this time, in the order of time."""
    nodes = GAUSS if exposure else ((0.0, 1.0),)
    return [(*pose_of(spline(time + 0.5 * exposure * x)), weight) for x, weight in nodes]


def write(folder, plan):
    """A recording's folder, with truth.npz beside recording.toml. Returns the folder."""
    folder, rng = Path(folder), np.random.default_rng([plan.seed, 7])
    cameras, target = cameras_of(plan, rng)
    both = {"left": cameras[0], "right": cameras[1]}
    dots = DOTS + plan.imperfections.misprint * rng.normal(size=DOTS.shape)
    for name in both:
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / "calibration" / name).mkdir(parents=True, exist_ok=True)

    def save(name, image):
        cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])

    for view in range(plan.n_views):
        R, t = board_pose(view, plan, target, rng)
        for name, camera in both.items():
            save(f"calibration/{name}/{view:04d}.png", board_image(camera, plan, R, t, rng))
    spline = motion(plan)
    times = np.arange(plan.n_frames) / plan.frame_rate
    for i, time in enumerate(times):
        poses = poses_during(spline, time, plan.imperfections.exposure)
        for name, camera in both.items():
            save(f"{name}/{i:06d}.png", disc_image(camera, plan, poses, dots, rng, i))
    centres = ", ".join(f"[{x * 1e3:.4f}, {y * 1e3:.4f}]" for x, y in DOTS)
    (folder / "recording.toml").write_text(
        f"""name = "{folder.name}"

[cameras]
frame_rate_hz = {plan.frame_rate}
left = "left/*.png"
right = "right/*.png"

[disc]
radius_mm = {RADIUS * 1e3}
thickness_mm = {HALF_THICKNESS * 2e3}
mass_g = {MASS * 1e3}

[markers]
diameter_mm = {DOT_RADIUS * 2e3}
centres_mm = [{centres}]

[calibration]
left = "calibration/left/*.png"
right = "calibration/right/*.png"
inner_corners = {[*plan.inner_corners]}
square_mm = {plan.square * 1e3}

[table]
view = 0
board_thickness_mm = {BOARD_THICKNESS * 1e3}

[gravity]
g_m_s2 = {G}
""",
        encoding="utf-8",
    )
    intrinsics = {f"{name}_intrinsics": np.array([camera.focal, *camera.middle]) for name, camera in both.items()}
    np.savez(folder / "truth.npz", q=spline(times), **intrinsics)
    return folder
