"""Targets of round dots in one image: OpenCV or the three marked dots number them, the circle template locates them.

The template (`track.dots`) fits a circle in the target's plane through each dot's own homography, so that what it finds
is the image of the dot's centre, not the centre of its ellipse. The diameter is measured in the image: nothing about
it need be declared.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.chessboard import SEARCH_SIZE, BoardNotFound, as_8_bit, grey_values
from calibration.board.corner_fit import CornerView
from calibration.board.target import CircleGrid, plane_symmetries
from calibration.kit.arrays import Array, Image, Mask
from disctrack.track.dots import DotCentres, NoiseModel, TemplateLimits, locate_on_plane
from disctrack.trajectory import MarkerStatus

MIN_ACCEPTED = 0.5  # share of a grid's circles that must be located for a view to count as found
LEAST_AREA = 12.0  # [px^2] of a circle in the rough search
# Print, compression and clipped ink misfit the template by more than the noise, in every dot alike. How much is learnt
# from the dots themselves, with nothing refused; against that, what is no dot stands out.
_LEARN, LIMITS = TemplateLimits(share=1.0, clipped=1.0), TemplateLimits(share=0.1, clipped=0.3)


@dataclass(frozen=True)
class Circles:
    """Circles of one image, located."""

    centres: DotCentres
    radius: float  # in units of the plane
    noise: NoiseModel
    spacing: float  # between neighbours [px]

    @property
    def good(self) -> Mask:
        """Which were measured (n,)."""
        found: Mask = (self.centres.status == MarkerStatus.MEASURED) & np.isfinite(self.centres.pixels).all(-1)
        return found


def whole_grey_values(grey: NDArray) -> Image:
    """Grey values as the template takes them: those of a colour image rounded."""
    return np.ascontiguousarray(grey if grey.dtype in (np.uint8, np.uint16) else np.rint(grey).astype(np.uint16))


def locate_circles(image: Image, plane: Array, rough: Array) -> Circles:
    """Centres of circles that lie at `plane` (n, 2) on a flat target and roughly at `rough` (n, 2) [px]."""
    maps, bend = _local_maps(plane, rough)
    radius = _radius(np.asarray(image, np.float32), maps, plane)
    J = _derivative(maps, plane)
    noise = flat_noise(image, rough, radius * float(np.sqrt(np.median(np.abs(np.linalg.det(J))))))
    for _ in range(2):
        misfit = locate_on_plane(image, maps, plane, radius, noise=noise, limits=_LEARN).misfit
        factor = float(np.nanmedian(misfit)) if np.isfinite(misfit).any() else 1.0
        noise = NoiseModel(max(factor, 1.0) * noise.read, max(factor, 1.0) * noise.gain)
    centres = locate_on_plane(image, maps, plane, radius, noise=noise, limits=LIMITS)
    corrected = replace(centres, pixels=centres.pixels - _shift_by_bend(bend, J, radius))
    return Circles(corrected, radius, noise, float(np.median(_distances(rough).min(axis=1))))


def find_circles(image: NDArray, grid: CircleGrid, thorough: bool = True) -> CornerView | BoardNotFound:
    """Locate the circles of a grid, dark on light or light on dark; all must be in view.

    image : (h, w) or (h, w, 3) as OpenCV reads it; see `chessboard.grey_values`
    thorough : also try OpenCV's search by clusters, which stands more perspective
    """
    grey, notes = grey_values(image)
    rough = _rough_centres(as_8_bit(grey), grid, thorough)
    if rough is None:
        return BoardNotFound(
            f"no {str(grid).partition(' ')[2]}: all circles must be in view, none cut off, on an even ground, and the "
            "counts be those of one row and of the rows"
        )
    pixels = whole_grey_values(grey)
    plane = grid.points[:, :2]
    rough = _ordered(rough, plane)
    circles = locate_circles(pixels, plane, rough)
    found, good = circles.centres, circles.good
    if good.mean() < MIN_ACCEPTED:
        return BoardNotFound(
            f"{good.sum()} of {len(good)} circles look like a circle under perspective: is the image sharp, the print "
            f"flat, and are they {'an asymmetric grid' if grid.asymmetric else 'a symmetric grid'}?"
        )
    return CornerView(
        image_size=(pixels.shape[1], pixels.shape[0]),
        points=np.where(good[:, None], found.pixels, rough),
        covariance=np.where(good[:, None, None], found.covariance_px2, np.eye(2)),
        accepted=good,
        reasons=tuple("" if ok else "no circle that the template fits: covered, dirty or in glare" for ok in good),
        chi_square=found.misfit,
        contrast=found.contrast * found.level,
        blur=found.blur_px,
        spacing=circles.spacing,
        noise=(circles.noise.read, circles.noise.gain),
        notes=notes,
    )


def _rough_centres(grey: NDArray[np.uint8], grid: CircleGrid, thorough: bool) -> Array | None:
    scale = min(1.0, SEARCH_SIZE / max(grey.shape))
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = LEAST_AREA, float(grey.size) / len(grid.points)
    parameters.minDistBetweenBlobs = 4.0
    detector = cv2.SimpleBlobDetector.create(parameters)
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if grid.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING) if thorough else (kind,):
        for seen in (grey, 255 - grey):
            found, centres = cv2.findCirclesGrid(seen, grid.circles, flags=flags, blobDetector=detector)
            points = np.asarray(centres if found else [], float).reshape(-1, 2)
            if len(points) == len(grid.points):
                return (points + 0.5) / scale - 0.5
    return None


def _ordered(rough: Array, plane: Array) -> Array:
    """The centres in an order that is seen from the printed side, and with i as far to the right as may be."""
    fits = []
    for order in (*plane_symmetries(plane), *plane_symmetries(plane, mirrored=True)):
        H, _ = cv2.findHomography(plane, rough[order])
        if H is None:
            continue
        derivative = _derivative(np.asarray(H, float)[None], plane.mean(0)[None])[0]
        if np.linalg.det(derivative) < 0:  # j upwards in the print is upwards in the image, whose rows grow downwards
            fits.append((float(derivative[0, 0] / np.linalg.norm(derivative[:, 0])), rough[order]))
    return max(fits, key=lambda fit: fit[0])[1] if fits else rough


def _local_maps(plane: Array, rough: Array) -> tuple[Array, Array]:
    """Homographies (n, 3, 3) with each dot's place and slope, and what they lack of second derivatives (n, 2, 2, 2).

    The lens bends the plane's image; a cubic in the plane's coordinates, beyond the common homography, follows it.
    """
    H, _ = cv2.findHomography(plane, rough)
    maps = np.tile(np.asarray(H, float), (len(plane), 1, 1))
    at = np.einsum("nij,nj->ni", maps, np.column_stack([plane, np.ones(len(plane))]))
    image = at[:, :2] / at[:, 2:]
    size = float(np.ptp(plane, axis=0).max())
    degree = 3 if len(plane) >= 24 else 2
    powers = [(a, b) for a in range(degree + 1) for b in range(degree + 1 - a)]

    def cubic(along_x: int, along_y: int) -> Array:
        """Derivative of every power (n, n_powers), so many times along x and y."""
        u = (plane - plane.mean(0)) / size
        columns = []
        for a, b in powers:
            factor = math.perm(a, along_x) * math.perm(b, along_y) / size ** (along_x + along_y)
            columns.append(factor * u[:, 0] ** max(a - along_x, 0) * u[:, 1] ** max(b - along_y, 0))
        return np.stack(columns, axis=-1)

    coefficients = np.linalg.lstsq(cubic(0, 0), rough - image, rcond=None)[0]
    slopes = np.stack([cubic(1, 0) @ coefficients, cubic(0, 1) @ coefficients], axis=-1)  # (n, pixel axis, plane axis)
    xx, xy, yy = (cubic(*order) @ coefficients for order in ((2, 0), (1, 1), (0, 2)))
    bend = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)
    J = _derivative(maps, plane)
    turn = (J + slopes) @ np.linalg.inv(J)  # in the image, about the dot
    T = np.tile(np.eye(3), (len(plane), 1, 1))
    T[:, :2, :2] = turn
    T[:, :2, 2] = rough - np.einsum("nij,nj->ni", turn, image)
    return T @ maps, bend


def _shift_by_bend(bend: Array, J: Array, radius: float) -> Array:
    """By how much (n, 2) [px] a circle seems to lie aside where the image of its plane is bent.

    q(x) = Q x x / 2 moves the rim of radius r by n . q(r n); the part of it that is a shift, s = 2 <n (n . q)> over the
    directions n, is s_m = r^2 / 8 (Q_mii + 2 Q_iim).
    """
    Q = np.einsum("nkm,nmij->nkij", np.linalg.inv(J), bend)
    s = 0.125 * radius**2 * (np.einsum("nmii->nm", Q) + 2 * np.einsum("niim->nm", Q))
    shift: Array = np.einsum("nij,nj->ni", J, s)
    return shift


def _derivative(maps: Array, plane: Array) -> Array:
    """(n, 2, 2) d pixel / d plane of homographies (n, 3, 3) at plane (n, 2)."""
    u = np.einsum("nij,nj->ni", maps, np.column_stack([plane, np.ones(len(plane))]))
    result: Array = (maps[:, :2, :2] - (u[:, :2] / u[:, 2:])[:, :, None] * maps[:, 2:, :2]) / u[:, 2, None, None]
    return result


def _radius(grey: NDArray[np.float32], maps: Array, plane: Array) -> float:
    """Radius in units of the plane: where the mean grey value over rings passes half of a circle's contrast."""
    gap = float(np.median(_distances(plane).min(axis=1)))
    rings = np.linspace(0.0, 0.5 * gap, 41)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = rings[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    at = np.concatenate([plane[:, None, None] + ring, np.ones((len(plane), *ring.shape[:2], 1))], axis=-1)
    u = np.einsum("nij,nraj->nrai", maps, at)
    where = (u[..., :2] / u[..., 2:]).astype(np.float32).reshape(len(plane), -1, 2)
    values = cv2.remap(grey, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = values.reshape(len(plane), len(rings), len(angle)).mean(-1)
    levels = profile[:, [0]], profile[:, [-1]]
    share = np.median((profile - levels[0]) / np.where(levels[1] == levels[0], np.inf, levels[1] - levels[0]), axis=0)
    for (r0, s0), (r1, s1) in pairwise(zip(rings.tolist(), share.tolist(), strict=True)):
        if s0 < 0.5 <= s1:
            return float(r0 + (0.5 - s0) / (s1 - s0) * (r1 - r0))
    return 0.25 * gap


def _distances(points: Array) -> Array:
    """Of every point (n, 2) to every other (n, n); infinite to itself."""
    return np.linalg.norm(points[:, None] - points, axis=-1) + np.where(np.eye(len(points)), np.inf, 0.0)


def flat_noise(image: Image, centres: Array, radius_px: float) -> NoiseModel:
    """Noise inside the dots and halfway to their neighbours, from differences of neighbouring pixels.

    Differences are free of the light's gradient. Ink that is clipped to black has no noise: the paper tells.
    """
    distance = _distances(centres)
    between = 0.5 * (centres + centres[distance.argmin(axis=1)])
    clear = 0.5 * float(np.median(distance.min(axis=1))) - radius_px
    # squares within the round clearing, foreshortened, less the blur of the edge
    ink, ink_level = _scatter(image, centres, max(int(0.5 * radius_px - 1), 1))
    paper, paper_level = _scatter(image, between, max(int(0.5 * clear - 1), 1))
    if ink_level > paper_level:  # light dots on a dark ground
        (ink, ink_level), (paper, paper_level) = (paper, paper_level), (ink, ink_level)
    floor = max(ink, 1 / 12)
    return NoiseModel(floor, max(0.02, (paper - floor) / max(paper_level, 1.0)))


def _scatter(image: Image, places: Array, half: int) -> tuple[float, float]:
    """Variance and level of the grey values in squares round the places: medians over the places."""
    parts = []
    for x, y in np.rint(places).astype(int):
        patch = image[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].astype(float)
        if patch.shape == (2 * half + 1, 2 * half + 1):
            parts.append((0.5 * np.mean(np.diff(patch, axis=1) ** 2), patch.mean()))
    variance, level = np.median(parts, axis=0) if parts else (1.0, 0.0)
    return float(variance), float(level)
