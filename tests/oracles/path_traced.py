"""Recordings by a path tracer (Mitsuba 3): the shadows and the soft light that a lamp of some size makes.

Motion, lens, sensor and folder are those of `imperfect_laboratory`, which share no line with the product; what each
pixel sees is traced through a scene of triangles and lamps. Every sample of a pixel is a ray of its own: a place in the
pixel and the blur of the lens. Textures are bitmaps of 20 to 40 um a cell.

    pip install mitsuba      # and LLVM 15 or later; DRJIT_LIBLLVM_PATH names its library
    python -m tests.oracles.path_traced FOLDER
"""

import os
import sys
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.special import ndtr

from tests.oracles import imperfect_laboratory as laboratory

R2 = 0.7548776662466927, 0.5698402909980532  # of the sequence that fills a square evenly
FACE = 0.08  # [m] side of the face's texture
TABLE = 0.5  # [m] side of the table
PAPER, DOT = 0.8, 0.06  # reflectance


@dataclass(frozen=True)
class Setup(laboratory.Plan):
    """A recording in a room with lamps."""

    n_frames: int = 24
    size: int = 320
    mm_per_px: float = 0.4
    n_views: int = 14
    imperfections: laboratory.Imperfections = laboratory.IDEAL
    samples: int = 16  # rays per pixel
    margin: int = 40  # [px] round disc or board that is traced for every image; the table beyond it, once
    square: float = 6.5e-3
    board_heights: tuple = (0.022, 0.045)  # clear of the table however it is tilted


def path_tracer():
    """Mitsuba, compiling for this machine."""
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_mono")
    drjit.set_thread_count(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count())))
    return mitsuba


class Studio:
    """A room of triangles with or without disc and board; what a camera sees of it."""

    def __init__(self, plan):
        self.mi, self.plan, self.rng = path_tracer(), plan, np.random.default_rng([plan.seed, 11])
        self.passes = 0
        self.lenses, self.empty = {}, {}
        x = np.linspace(-4, 4, 20001)
        blurred = ndtr((x + 0.5) / plan.blur) - ndtr((x - 0.5) / plan.blur)  # a pixel through the lens
        share = np.cumsum(blurred) / blurred.sum()
        self.spread = np.interp((np.arange(4096) + 0.5) / 4096, share, x).astype(np.float32)
        self.sampler = self.mi.load_dict({"type": "independent"})

    def disc_image(self, camera, plan, poses, dots, rng, frame=0):
        """One frame; poses: (R, t, weight), one of them, as the exposure is an instant."""
        scene, places = self.with_disc
        ((R, t, _),) = poses
        self.put(scene, places, R, t)
        light = self.look(scene, camera, plan.samples, places["disc_face"] @ R.T + t)
        return camera.expose(plan.paper * light / self.white, rng)

    def board_image(self, camera, plan, R, t, rng):
        """One view of the board; R, t of the printed face, its origin at corner 0."""
        scene, places = self.with_board
        self.put(scene, places, R, t)
        light = self.look(scene, camera, plan.samples, places["board_face"] @ R.T + t)
        return camera.expose(plan.paper * light / self.white, rng)

    @cached_property
    def white(self):
        """Radiance of white paper that lies on the table: the exposure is set once, by an evenly lit sheet."""
        sheet = self.part(_moved(_grid(0.02, 0.02, 2), (0, 0, 1e-3)), self.matt(PAPER))
        scene, _ = self.build({"sheet": sheet})
        return float(np.median(self.look(scene, _Above(), 64)))

    @cached_property
    def with_disc(self):
        """The scene of the frames, and the parts that move."""
        h, side = laboratory.HALF_THICKNESS, self.matt(0.35)
        return self.build(
            {
                "disc_face": self.part(_annulus(laboratory.RADIUS, h), self.printed(face_picture())),
                "disc_rim": self.part(_tube(laboratory.RADIUS, h), side),
                "disc_back": self.part(_annulus(laboratory.RADIUS, -h), side),
            }
        )

    @cached_property
    def with_board(self):
        """The scene of the views."""
        plan, a = self.plan, self.plan.square
        vertices, triangles, uv = _grid(11 * a, 8 * a, 40)
        vertices[:, :2] -= 1.5 * a
        vertices[:, 2] = laboratory.board_height(vertices[:, 0], plan)
        return self.build({"board_face": self.part((vertices, triangles, uv), self.printed(board_picture()))})

    def build(self, parts):
        """Scene, and {part: vertices in its own axes}."""
        mi = self.mi
        T, room = mi.ScalarTransform4f, {"type": "scene", **{k: v[0] for k, v in parts.items()}}
        room["table"] = {"type": "rectangle", "to_world": T().scale(TABLE / 2), "bsdf": self.table_surface()}
        target = [0.03, 0.02, 0.0]
        side, share, ambient = 0.2, 0.4, 0.2  # [m] of a lamp; of the light from each, and from everywhere
        for i, lamp in enumerate([(20.0, 65.0), (200.0, 65.0)]):  # azimuth and height over the table [deg]
            az, up = np.radians(lamp)
            place = np.array(target) + 0.9 * np.array([np.cos(up) * np.cos(az), np.cos(up) * np.sin(az), np.sin(up)])
            room[f"lamp_{i}"] = {
                "type": "rectangle",
                "to_world": T().look_at(place.tolist(), target, [0.3, 0.1, 1]).scale(side / 2),
                "emitter": {"type": "area", "radiance": float(share * 0.9**2 / (side**2 * np.sin(up)))},
            }
        room["sky"] = {"type": "constant", "radiance": float(ambient / np.pi)}
        return mi.load_dict(room), {name: vertices for name, (_, vertices) in parts.items()}

    def put(self, scene, places, R, t):
        """Move the scene's body to R, t."""
        known = self.mi.traverse(scene)
        for name, vertices in places.items():
            known[f"{name}.vertex_positions"] = (vertices @ R.T + t).astype(np.float32).ravel()
        known.update()

    def look(self, scene, camera, samples, body=None):
        """Radiance (size, size) that a camera collects, by so many rays per pixel; far from a body, once."""
        picture = np.empty((camera.size, camera.size))
        box = np.s_[:, :]
        if body is not None:
            x, y = camera.project(body).T
            low, high = np.array([[y.min(), x.min()], [y.max() + 1, x.max() + 1]]).round().astype(int)
            (top, left), (bottom, right) = np.clip([low - self.plan.margin, high + self.plan.margin], 0, camera.size)
            box = np.s_[top:bottom, left:right]
            picture[:] = self.behind(camera)
        light = self.collected(scene, camera, np.arange(camera.size**2).reshape(picture.shape)[box].ravel(), samples)
        picture[box] = light.reshape(picture[box].shape)
        return picture

    def collected(self, scene, camera, pixels, samples):
        """Radiance of some pixels (n,), numbered row by row."""
        import drjit as dr

        mi, plan = self.mi, self.plan
        n = len(pixels)
        self.passes += 1
        self.sampler.seed(int(100000 * plan.seed + self.passes), n * samples)
        i = dr.arange(mi.UInt32, n * samples)
        i, turn = i // samples, i % samples
        ray, jacobian = self.lens(camera)
        shift = self.rng.random((2, n), np.float32)
        x, y = [dr.gather(mi.Float, mi.Float(s), i) + mi.Float(turn) * a for s, a in zip(shift, R2, strict=True)]
        spread = mi.Float(self.spread)
        x, y = [dr.gather(mi.Float, spread, mi.UInt32((c - dr.floor(c)) * len(self.spread))) for c in (x, y)]
        at = dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), i)
        ray, jacobian = ([dr.gather(mi.Float, part, at) for part in parts] for parts in (ray, jacobian))
        d = ray[0] + jacobian[0] * x + jacobian[1] * y, ray[1] + jacobian[2] * x + jacobian[3] * y
        place, R = camera.place.tolist(), camera.R.tolist()
        d = [R[0][k] * d[0] + R[1][k] * d[1] + R[2][k] for k in range(3)]
        rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*place), dr.normalize(mi.Vector3f(*d))))
        return np.array(dr.block_sum(self.trace(scene, rays), samples)) / samples

    def behind(self, camera):
        """What a camera sees of the table; traced once, by fifty samples."""
        if id(camera) not in self.empty:
            self.empty[id(camera)] = self.look(self.build({})[0], camera, 50)
        return self.empty[id(camera)]

    def trace(self, scene, rays):
        """Radiance along each ray. Every lamp is asked at every hit, which leaves little noise beside the sensor's."""
        import drjit as dr

        mi, sampler = self.mi, self.sampler
        context, share, pdf = mi.BSDFContext(), mi.Float(1.0), mi.Float(-1.0)  # pdf < 0: seen by the camera itself
        total, before = mi.Float(0.0), dr.zeros(mi.Interaction3f)
        for last in (False, True):
            hit = scene.ray_intersect(rays)
            emitter = hit.emitter(scene)
            by_lamp = emitter.pdf_direction(before, mi.DirectionSample3f(scene, hit, before), hit.is_valid())
            weight = dr.select((pdf < 0) | ~hit.is_valid(), 1.0, pdf / dr.maximum(pdf + by_lamp, 1e-9))
            total += share * weight * emitter.eval(hit)[0]
            if last:
                return total
            surface, there = hit.bsdf(rays), hit.is_valid()
            for lamp in (lamp for lamp in scene.emitters() if not lamp.is_environment()):
                to, light = lamp.sample_direction(hit, sampler.next_2d(), there)
                value, chance = surface.eval_pdf(context, hit, hit.to_local(to.d), there)
                clear = there & (to.pdf > 0) & ~scene.ray_test(hit.spawn_ray_to(to.p), there)
                total += dr.select(clear, share * value[0] * light[0] * to.pdf / (to.pdf + chance), 0.0)
            way, value = surface.sample(context, hit, sampler.next_1d(), sampler.next_2d(), there)
            share = dr.select(there, share * value[0], 0.0)
            pdf, before = way.pdf, mi.Interaction3f(hit)
            rays = mi.RayDifferential3f(hit.spawn_ray(hit.to_world(way.wo)))

    def lens(self, camera):
        """Slopes of every pixel's ray, two of (n,), and how they change within the pixel, four of (n,)."""
        if id(camera) not in self.lenses:
            grid = np.stack(np.meshgrid(*[np.arange(camera.size, dtype=float)] * 2), -1).reshape(-1, 2)
            change = np.stack([camera.slopes(grid + e) - camera.slopes(grid - e) for e in np.eye(2)], -1) / 2
            ray, jacobian = camera.slopes(grid).T, change.reshape(-1, 4).T
            self.lenses[id(camera)] = [
                [self.mi.Float(p.astype(np.float32)) for p in parts] for parts in (ray, jacobian)
            ]
        return self.lenses[id(camera)]

    def part(self, body, surface):
        """A mesh, and its vertices."""
        vertices, triangles, uv = body
        settings = self.mi.Properties()
        settings["bsdf"] = self.mi.load_dict(surface)
        mesh = self.mi.Mesh("part", len(vertices), len(triangles), has_vertex_texcoords=True, props=settings)
        values = self.mi.traverse(mesh)
        values["vertex_positions"] = vertices.astype(np.float32).ravel()
        values["faces"] = triangles.astype(np.uint32).ravel()
        values["vertex_texcoords"] = uv.astype(np.float32).ravel()
        values.update()
        return mesh, vertices

    def matt(self, reflectance):
        return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": reflectance}}

    def printed(self, picture):
        ink = self.mi.Bitmap(picture[..., None].astype(np.float32))
        return self.matt({"type": "bitmap", "bitmap": ink, "raw": True, "wrap_mode": "clamp"})

    def table_surface(self):
        """What the disc rolls on."""
        rng, n = np.random.default_rng([self.plan.seed, 13]), 2048
        grain = cv2.GaussianBlur(rng.normal(size=(n, n)), (0, 0), 3)
        return self.printed(np.clip(0.33 + 0.01 * grain / grain.std(), 0.03, 0.9))


class _Above:
    """A camera straight above the place where the disc rolls, for setting the exposure."""

    size, place, R = 16, np.array([0.01, 0.01, 0.4]), np.diag([1.0, -1.0, -1.0])

    def slopes(self, pixels):
        return (pixels - 7.5) * 1e-3


def face_picture():
    """Reflectance of the upper face over FACE x FACE, row 0 at the smallest y."""
    n, fine = 2048, 4
    picture = np.full((n, n), PAPER)
    cell = FACE / n
    around = int(1.3 * laboratory.DOT_RADIUS / cell)
    for x, y in laboratory.DOTS:
        i, j = round((y + FACE / 2) / cell), round((x + FACE / 2) / cell)
        sub = ((np.arange(2 * around * fine) + 0.5) / fine - around) * cell
        u, v = sub + j * cell - FACE / 2 - x, sub + i * cell - FACE / 2 - y
        inside = np.clip(0.5 - (np.hypot(u, v[:, None]) - laboratory.DOT_RADIUS) / (cell / fine), 0, 1)
        cover = inside.reshape(2 * around, fine, 2 * around, fine).mean((1, 3))
        picture[i - around : i + around, j - around : j + around] += cover * (DOT - PAPER)
    return picture


def board_picture():
    """Reflectance of 10 x 7 squares with half a square of rim, 40 cells to a square; row 0 at the smallest y."""
    rows, columns = np.arange(8 * 40) / 40 - 1.5, np.arange(11 * 40) / 40 - 1.5
    black = (np.floor(rows)[:, None] + np.floor(columns)) % 2 == 0
    inside = (np.abs(rows - 2.5) < 3.5)[:, None] & (np.abs(columns - 4) < 5)
    return np.where(black & inside, DOT, PAPER)


def _grid(width, height, n):
    """A rectangle from the origin: vertices (m, 3), triangles (k, 3), texture (m, 2)."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    uv = np.column_stack([x.ravel(), y.ravel()])
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.column_stack([i, i + 1, i + n + 1]), np.column_stack([i, i + n + 1, i + n])])
    return np.column_stack([uv * [width, height], np.zeros(n * n)]), triangles, uv


def _moved(body, by):
    return (body[0] + np.array(by), *body[1:])


def _strip(inner, outer, n=720):
    """Between two circles (radius, height): texture by x and y."""
    angle = 2 * np.pi * np.arange(n) / n
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    vertices = np.concatenate([np.column_stack([radius * circle, np.full(n, z)]) for radius, z in (inner, outer)])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    triangles = np.concatenate([np.column_stack([i, i + n, j + n]), np.column_stack([i, j + n, j])])
    return vertices, triangles, vertices[:, :2] / FACE + 0.5


def _annulus(radius, z):
    return _strip((0.0, z), (radius, z))


def _tube(radius, h):
    return _strip((radius, -h), (radius, h))


if __name__ == "__main__":
    studio = Studio(Setup())
    laboratory.write(sys.argv[1], studio.plan, studio.board_image, studio.disc_image)
