"""Recordings by a path tracer (Mitsuba 3): shadows, glare, reflections, defocus and hands as light makes them.

Motion, lens, sensor and folder are those of `imperfect_laboratory`, which share no line with the product; what each
pixel sees is traced through a scene of triangles and lamps. Every sample of a pixel is a ray of its own: a place in the
pixel and the blur of the lens, a point of the aperture. Textures are bitmaps of 20 to 40 um a cell.

    pip install mitsuba      # and LLVM 15 or later; DRJIT_LIBLLVM_PATH names its library
    python -m tests.oracles.path_traced FOLDER --scene cloth [--seed 3] [--effect kz] [--imperfect]
"""

import argparse
import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.special import ndtr

from tests.oracles import imperfect_laboratory as laboratory

R2 = 0.7548776662466927, 0.5698402909980532  # of the sequence that fills a square evenly
FACE = 0.08  # [m] side of the face's texture
TABLE = 0.5  # [m] side of the table
AWAY = np.array([0.0, 0.0, -1.0])  # under the table, where no ray goes


@dataclass(frozen=True)
class Setup(laboratory.Plan):
    """A recording, and what stands in the room.

    lamps : azimuth and height over the table [deg], side [m], share of the light
    """

    n_frames: int = 24
    size: int = 320
    mm_per_px: float = 0.4
    n_views: int = 14
    imperfections: laboratory.Imperfections = laboratory.IDEAL
    samples: int = 16  # rays per pixel
    bounces: int = 1  # of light after the first surface
    margin: int = 40  # [px] round disc or board that is traced for every image; the table beyond it, once
    nodes: int = 1  # instants of an exposure
    square: float = 6.5e-3
    board_heights: tuple = (0.022, 0.045)  # clear of the table however it is tilted
    lamps: tuple = ((20.0, 65.0, 0.2, 0.4), (200.0, 65.0, 0.2, 0.4))
    ambient: float = 0.2  # share of the light that comes from everywhere
    face: tuple = (0.8, 0.06)  # reflectance of paper and dots
    gloss: float = 0.0  # roughness of a coat over the face; 0 is none
    hole: float = 0.0  # [m] radius of a hole through the disc
    dot_scale: tuple = (1.0,) * 6  # of the dots' radii
    dust: int = 0  # specks on the face
    table: str = "plain"  # or cloth, wood, gloss
    second_disc: bool = False  # lying on the table
    covered: range = range(0)  # frames with a hand over half of the disc
    held: bool = False  # the board, by fingers at its rim
    board_gloss: float = 0.0
    aperture: float = 0.0  # [m] radius of the lens
    focus: float = 0.42  # [m] what is sharp
    scene: str = field(default="", compare=False)


SCENES = {
    "plain": {},
    "defocus": {
        "aperture": 4e-3,
        "focus": 0.40,
        "nodes": 8,
        "samples": 24,
        "imperfections": replace(laboratory.IDEAL, exposure=1e-3),
    },
    "cloth": {"table": "cloth"},
    "ring": {"hole": 8e-3},
    "thick": {"half_thickness": 10e-3},
    "unequal": {"dot_scale": (1.0, 0.9, 1.1, 0.95, 1.05, 1.0)},
    "white_dots": {"face": (0.05, 0.8), "table": "wood"},
    "hand": {"covered": range(8, 16), "table": "wood"},
    "glossy_board": {"board_gloss": 0.15},
    "bent_board": {"imperfections": replace(laboratory.IDEAL, bow=300e-6)},
    "held_board": {"held": True, "table": "wood"},
    "low_sun": {"lamps": ((200.0, 20.0, 0.01, 0.8),), "table": "wood", "margin": 320},
    "flicker": {"trouble": laboratory.Trouble(flicker=0.2), "table": "wood"},
    "dust": {"dust": 400, "gloss": 0.3},
    "second_disc": {"second_disc": True, "size": 400, "mm_per_px": 0.48, "table": "wood"},
    "gloss": {"table": "gloss", "bounces": 2},
    "flat": {"theta_deg": 2.0, "omega3": 0.2},
    "steep": {"theta_deg": 60.0, "omega3": 3.0},
    "small": {  # to be diagnosed
        "size": 256,
        "mm_per_px": 0.5,
        "n_frames": 250,
        "frame_rate": 500.0,
        "n_views": 16,
        "margin": 20,
    },
}


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
        self.lenses, self.empty, self.lying = {}, {}, {}
        x = np.linspace(-4, 4, 20001)
        blurred = ndtr((x + 0.5) / plan.blur) - ndtr((x - 0.5) / plan.blur)  # a pixel through the lens
        share = np.cumsum(blurred) / blurred.sum()
        self.spread = np.interp((np.arange(4096) + 0.5) / 4096, share, x).astype(np.float32)
        self.sampler = self.mi.load_dict({"type": "independent"})

    def disc_image(self, camera, plan, poses, dots, rng, frame=0):
        """One frame; poses: (R, t, weight) over the exposure."""
        scene, places = self.with_disc(tuple(map(tuple, dots)))
        poses = [pose for pose in poses if pose[2]]
        palm = poses[len(poses) // 2][1] + [0.03, 0.0, 0.035] if frame in plan.covered else AWAY
        light = 0.0
        for R, t, weight in poses:
            self.put(scene, places, {"disc": (R, t), "hand": (np.eye(3), palm + 1e-3 * np.sin(frame))})
            body = places["disc_face"] @ R.T + t
            light = light + weight * self.look(scene, camera, plan.samples // len(poses), body)
        light *= 1 + plan.trouble.flicker * np.sin(2 * np.pi * 100 * frame / plan.frame_rate + 0.4)
        return plan.trouble.after(camera, camera.expose(plan.paper * light / self.white, rng))

    def board_image(self, camera, plan, R, t, rng):
        """One view of the board; R, t of the printed face, its origin at corner 0."""
        scene, places = self.with_board
        self.put(scene, places, {"board": (R, t)})
        light = self.look(scene, camera, plan.samples, places["board_face"] @ R.T + t)
        return camera.expose(plan.paper * light / self.white, rng)

    @cached_property
    def white(self):
        """Radiance of white paper that lies on the table: the exposure is set once, by an evenly lit sheet."""
        sheet = self.part(_moved(_grid(0.02, 0.02, 2), (0, 0, 1e-3)), self.matt(0.8))
        scene, _ = self.build({"sheet": sheet})
        return float(np.median(self.look(scene, _Above(), 64)))

    def with_disc(self, dots):
        """The scene of the frames, and the parts that move."""
        if "disc" not in self.__dict__:
            h, plan = self.plan.half_thickness, self.plan
            faces = _annulus(plan.hole, laboratory.RADIUS, h)
            rims = [_tube(laboratory.RADIUS, h), _annulus(plan.hole, laboratory.RADIUS, -h)]
            rims += [_tube(plan.hole, h)] if plan.hole else []
            print_ = self.printed(self.face_picture(dots), plan.gloss)
            surfaces = [print_, *[self.matt(0.35)] * len(rims)]
            names = ["disc_face", *[f"disc_{i}" for i in range(len(rims))]]
            bodies = list(zip([faces, *rims], surfaces, names, strict=True))
            parts = {name: self.part(body, surface) for body, surface, name in bodies}
            if plan.second_disc:
                for body, surface, name in bodies:
                    self.lying[f"lying_{name}"] = self.part(_moved(body, (0.112, 0.05, h)), surface)
            if plan.covered:
                parts["hand_palm"] = self.part(_ellipsoid(0.03, 0.06, 0.012), self.matt(0.45))
            self.disc = self.build(parts | self.lying)
            self.empty = {}
        return self.disc

    @cached_property
    def with_board(self):
        """The scene of the views."""
        plan, a = self.plan, self.plan.square
        vertices, triangles, uv = _grid(11 * a, 8 * a, 40)
        vertices[:, :2] -= 1.5 * a
        vertices[:, 2] = laboratory.board_height(vertices[:, 0], plan)
        parts = {"board_face": self.part((vertices, triangles, uv), self.printed(board_picture(), plan.board_gloss))}
        if plan.held:
            finger = _ellipsoid(0.014, 0.007, 0.006)
            for i, (x, y) in enumerate([(-2.0, 2.4), (10.0, 1.4), (10.0, 3.2)]):
                parts[f"board_finger_{i}"] = self.part(_moved(finger, (x * a, y * a, 0.004)), self.matt(0.45))
        return self.build(parts)

    def build(self, parts):
        """Scene, and {part: vertices in its own axes}."""
        mi, plan = self.mi, self.plan
        T, room = mi.ScalarTransform4f, {"type": "scene", **{k: v[0] for k, v in parts.items()}}
        room["table"] = {"type": "rectangle", "to_world": T().scale(TABLE / 2), "bsdf": self.table_surface()}
        target = [0.03, 0.02, 0.0]
        for i, (azimuth, height, side, share) in enumerate(plan.lamps):
            az, up = np.radians([azimuth, height])
            place = np.array(target) + 0.9 * np.array([np.cos(up) * np.cos(az), np.cos(up) * np.sin(az), np.sin(up)])
            radiance = share * 0.9**2 / (side**2 * np.sin(up))
            room[f"lamp_{i}"] = {
                "type": "rectangle",
                "to_world": T().look_at(place.tolist(), target, [0.3, 0.1, 1]).scale(side / 2),
                "emitter": {"type": "area", "radiance": float(radiance)},
            }
        room["sky"] = {"type": "constant", "radiance": float(plan.ambient / np.pi)}
        return mi.load_dict(room), {name: vertices for name, (_, vertices) in parts.items()}

    def put(self, scene, places, poses):
        """Move bodies (names begin alike) to R, t."""
        known = self.mi.traverse(scene)
        for name, vertices in places.items():
            for body, (R, t) in poses.items():
                if name.startswith(body):
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
        u, v = self.sampler.next_1d(), self.sampler.next_1d()
        out = plan.aperture * dr.sqrt(u)
        hole = out * dr.cos(2 * np.pi * v), out * dr.sin(2 * np.pi * v)
        d = plan.focus * d[0] - hole[0], plan.focus * d[1] - hole[1], mi.Float(plan.focus)
        place, R = camera.place.tolist(), camera.R.tolist()
        o = [place[k] + R[0][k] * hole[0] + R[1][k] * hole[1] for k in range(3)]
        d = [R[0][k] * d[0] + R[1][k] * d[1] + R[2][k] * d[2] for k in range(3)]
        rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*o), dr.normalize(mi.Vector3f(*d))))
        return np.array(dr.block_sum(self.trace(scene, rays), samples)) / samples

    def behind(self, camera):
        """What a camera sees of the table and of what lies on it; traced once, by fifty samples."""
        if id(camera) not in self.empty:
            self.empty[id(camera)] = self.look(self.build(self.lying)[0], camera, 50)
        return self.empty[id(camera)]

    def trace(self, scene, rays):
        """Radiance along each ray. Every lamp is asked at every hit, which leaves little noise beside the sensor's."""
        import drjit as dr

        mi, sampler = self.mi, self.sampler
        context, share, pdf = mi.BSDFContext(), mi.Float(1.0), mi.Float(-1.0)  # pdf < 0: seen by the camera itself
        total, before = mi.Float(0.0), dr.zeros(mi.Interaction3f)
        for left in range(self.plan.bounces, -1, -1):
            hit = scene.ray_intersect(rays)
            emitter = hit.emitter(scene)
            by_lamp = emitter.pdf_direction(before, mi.DirectionSample3f(scene, hit, before), hit.is_valid())
            weight = dr.select((pdf < 0) | ~hit.is_valid(), 1.0, pdf / dr.maximum(pdf + by_lamp, 1e-9))
            total += share * weight * emitter.eval(hit)[0]
            if not left:
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

    def printed(self, picture, roughness=0.0):
        """A print, with a coat of so much roughness."""
        ink = {
            "type": "bitmap",
            "bitmap": self.mi.Bitmap(picture[..., None].astype(np.float32)),
            "raw": True,
            "wrap_mode": "clamp",
        }
        if not roughness:
            return self.matt(ink)
        coated = {"type": "roughplastic", "alpha": roughness, "diffuse_reflectance": ink, "nonlinear": True}
        return {"type": "twosided", "surface": coated}

    def table_surface(self):
        """What the disc rolls on."""
        plan = self.plan
        if plan.table == "gloss":
            return {"type": "roughplastic", "alpha": 0.03, "diffuse_reflectance": 0.1}
        rng, n = np.random.default_rng([plan.seed, 13]), 2048
        grain = cv2.GaussianBlur(rng.normal(size=(n, n)), (0, 0), 3)
        picture = 0.33 + 0.01 * grain / grain.std()
        if plan.table == "cloth":
            cell = np.arange(n) * TABLE / n // 0.012 % 2
            picture += 0.22 * (cell[:, None] + cell - 1) + 0.03 * rng.normal(size=(n, n))
        if plan.table == "wood":
            y, x = np.mgrid[:n, :n] / n
            rings = np.sin(120 * (y + 0.05 * np.sin(5 * x) + 0.02 * np.sin(17 * x + 3)))
            picture += 0.07 * rings + 0.03 * cv2.GaussianBlur(rng.normal(size=(n, n)), (61, 1), 20) * 4
        return self.printed(np.clip(picture, 0.03, 0.9))

    def face_picture(self, dots):
        """Reflectance of the upper face over FACE x FACE, row 0 at the smallest y."""
        plan, n, fine = self.plan, 2048, 4
        picture = np.full((n, n), plan.face[0])
        cell = FACE / n
        around = int(1.3 * laboratory.DOT_RADIUS / cell)
        rng = np.random.default_rng([plan.seed, 17])
        spots = [
            (x, y, laboratory.DOT_RADIUS * s, plan.face[1]) for (x, y), s in zip(dots, plan.dot_scale, strict=True)
        ]
        for _ in range(plan.dust):
            x, y = rng.uniform(-laboratory.RADIUS, laboratory.RADIUS, 2)
            spots.append((x, y, rng.uniform(0.05e-3, 0.2e-3), rng.choice([0.1, 0.75])))
        for x, y, radius, ink in spots:
            i, j = round((y + FACE / 2) / cell), round((x + FACE / 2) / cell)
            box = np.s_[max(i - around, 0) : i + around, max(j - around, 0) : j + around]
            rows, columns = (np.arange(b.start, min(b.stop, n)) for b in box)
            sub = (np.arange(fine) + 0.5) / fine
            v = (rows[:, None] + sub).ravel() * cell - FACE / 2 - y
            u = (columns[:, None] + sub).ravel() * cell - FACE / 2 - x
            inside = np.clip(0.5 - (np.hypot(u, v[:, None]) - radius) / (cell / fine), 0, 1)
            cover = inside.reshape(len(rows), fine, len(columns), fine).mean((1, 3))
            picture[box] += cover * (ink - picture[box])
        return picture


class _Above:
    """A camera straight above the place where the disc rolls, for setting the exposure."""

    size, place, R = 16, np.array([0.01, 0.01, 0.4]), np.diag([1.0, -1.0, -1.0])

    def slopes(self, pixels):
        return (pixels - 7.5) * 1e-3


def board_picture():
    """Reflectance of 10 x 7 squares with half a square of rim, 40 cells to a square; row 0 at the smallest y."""
    rows, columns = np.arange(8 * 40) / 40 - 1.5, np.arange(11 * 40) / 40 - 1.5
    black = (np.floor(rows)[:, None] + np.floor(columns)) % 2 == 0
    inside = (np.abs(rows - 2.5) < 3.5)[:, None] & (np.abs(columns - 4) < 5)
    return np.where(black & inside, 0.06, 0.8)


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


def _annulus(inner, outer, z):
    return _strip((inner, z), (outer, z))


def _tube(radius, h):
    return _strip((radius, -h), (radius, h))


def _ellipsoid(a, b, c, n=48):
    """Vertices about its centre."""
    _, triangles, uv = _grid(1, 1, n)
    east, north = 2 * np.pi * uv[:, 0], np.pi * (uv[:, 1] - 0.5)
    round_ = np.column_stack([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])
    return round_ * [a, b, c], triangles, uv


def write(folder, plan):
    """A recording's folder, as `imperfect_laboratory.write` makes it. Returns the folder."""
    studio = Studio(plan)
    return laboratory.write(folder, plan, studio.board_image, studio.disc_image, plan.nodes)


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description="Render a recording by a path tracer.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", choices=SCENES, default="plain")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--effect", choices=sorted(laboratory.EFFECTS), default="none")
    parser.add_argument("--lag-us", type=float, default=0.0, help="by which the right camera is late")
    parser.add_argument("--wrong-dot-um", type=float, default=0.0, help="by which dot 1 is misprinted")
    parser.add_argument("--imperfect", action="store_true", help="lens, board and sensor of an ordinary laboratory")
    asked = parser.parse_args()
    plan = Setup(asked.seed, effect=asked.effect, lag=1e-6 * asked.lag_us, wrong_dot=1e-6 * asked.wrong_dot_um)
    plan = replace(plan, **SCENES[asked.scene])
    if asked.frames:
        plan = replace(plan, n_frames=asked.frames)
    if asked.imperfect:
        plan = replace(plan, imperfections=laboratory.Imperfections(exposure=plan.imperfections.exposure))
    write(asked.folder, plan)


if __name__ == "__main__":
    main()
