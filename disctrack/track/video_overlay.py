"""A video that shows the eye what was measured: fitted disc and dots drawn over the frames of both cameras."""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from calibration.kit.grey_levels import full_scale
from calibration.kit.types import AnyArray, Array, Mask, checked
from disctrack.errors import OutputError
from disctrack.files.whole import whole_file
from disctrack.frames import CAMERAS, nodal_axes_world, rotation_from_quaternion
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

ColourImage = AnyArray  # (height, width, 3) uint8, BGR

PLAYBACK_HZ = 25.0
POINTS = 120  # of an outline
CAPTION_LINE = 18  # height of a line [px]
_SUBPIXEL_BITS = 4  # OpenCV draws at fractions of 1/16 px

_COLOURS = {  # blue, green, red as OpenCV orders them
    "text": (230, 230, 230),
    "upper rim": (80, 220, 80),
    "lower rim": (90, 140, 60),
    "dot": (255, 190, 60),
    "centre": (60, 60, 255),
    "refused": (60, 160, 255),
    "contact": (240, 80, 240),
}


@checked
def write_overlay(
    path: str | Path,
    pairs: Iterable[tuple[int, AnyArray]],
    trajectory: Trajectory,
    progress: Callable[[int], None] = lambda n: None,
) -> Path:
    """Video (mp4) of the pairs with the fitted disc and dots drawn on them.

    pairs : (row of the trajectory, images (2, height, width)) in order
    Raises OutputError.

        >>> pairs = open_pairs("clip")
        >>> frames = ((i, np.array([pairs.left.read(i), pairs.right.read(i)])) for i in range(5))
        >>> write_overlay("five.mp4", frames, read_trajectory("clip")).name
        'five.mp4'
    """
    path, pictures = Path(path), (draw_pair(images, trajectory, row) for row, images in pairs)
    first = next(pictures, None)
    if first is None:
        raise OutputError(f"{path}: no frame to draw")
    with whole_file(path, suffix=".mp4") as part, _encoder(part, first.shape[:2]) as write:
        for picture in chain([first], pictures):
            write(picture)
            progress(1)
    return path


def shown_rows(start: int, stop: int) -> range:
    """Rows that an overlay of start..stop-1 shows: all, or every second, third, ... one, for a minute of video."""
    return range(start, stop, max(1, math.ceil((stop - start) / (60 * PLAYBACK_HZ))))


def draw_pair(images: AnyArray, trajectory: Trajectory, row: int) -> ColourImage:
    """Both images side by side, (height, 2 width, 3) BGR, with what row `row` of the trajectory says.

    images : (2, height, width) uint8 or uint16
    """
    height, width = images.shape[1:]
    captions = _caption(trajectory, row)
    whole = np.zeros((height + CAPTION_LINE * len(captions) + 6, 2 * width, 3), np.uint8)
    pictures = [whole[:height, :width], whole[:height, width:]]
    for image, picture in zip(images, pictures, strict=True):
        # deep images are scaled from the full scale of their camera, so that brightness is steady
        cv2.cvtColor(cv2.convertScaleAbs(image, alpha=255 / full_scale(image)), cv2.COLOR_GRAY2BGR, dst=picture)
    if trajectory.measured[row]:
        _draw_disc(pictures, trajectory, row)
    dots, states = trajectory.markers_px[row], trajectory.marker_status[row]
    for camera, picture in enumerate(pictures):
        for point, status in zip(dots[camera], states[camera], strict=True):
            colour = "centre" if status == MarkerStatus.MEASURED else "refused"
            _cross(picture, point, colour, cv2.MARKER_CROSS, 7)
        _write(picture, 0, CAMERAS[camera], "text")
    for line, text in enumerate(captions):
        _write(whole[height:], line, text, "text" if trajectory.measured[row] else "refused")
    return whole[: whole.shape[0] // 2 * 2, : whole.shape[1] // 2 * 2]  # video codecs want even sizes


def _write(picture: ColourImage, line: int, text: str, colour: str) -> None:
    place, font = (8, CAPTION_LINE * (line + 1) - 3), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(picture, text, place, font, 0.45, _COLOURS[colour], 1, cv2.LINE_AA)


def _caption(trajectory: Trajectory, row: int) -> list[str]:
    """Lines below the images."""
    head = f"frame {trajectory.frame[row]}  t = {trajectory.time[row]:.4f} s"
    if not trajectory.measured[row]:
        return [head, FrameStatus(trajectory.frame_status[row]).sentence, "", ""]  # as many as of any frame
    q = trajectory.q[row]
    x, y, z = q[:3] * 1e3
    psi, theta, phi = np.degrees(q[3:])
    errors = " ".join("-" if np.isnan(rms) else f"{rms:.3f}" for rms in trajectory.reprojection_rms_px[row])
    return [
        head,
        f"x {x:.3f}  y {y:.3f}  z {z:.3f} mm",
        f"psi {psi:.2f}  theta {theta:.3f}  phi {phi:.2f} deg",
        f"error {errors} px",
    ]


def _draw_disc(pictures: list[ColourImage], trajectory: Trajectory, row: int) -> None:
    disc, rig = trajectory.disc, trajectory.rig
    R, t = rotation_from_quaternion(trajectory.quaternion[row]), trajectory.q[row, :3]
    h = disc.half_thickness
    angle = np.linspace(0, 2 * np.pi, POINTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(POINTS)], axis=-1)
    lower, upper = (disc.radius * circle + [0.0, 0.0, z] for z in (-h, h))
    dots = disc.marker_centres_body[:, None] + 0.5 * disc.marker_diameter * circle
    outlines = np.stack([lower, upper, *dots]) @ R.T + t
    lower = outlines[0]
    _, e2, e3 = nodal_axes_world(*trajectory.q[row, 3:5])
    contact = t + disc.arm_to_contact(e2, e3)
    points = np.concatenate([outlines.reshape(-1, 3), contact[None]])
    for picture, seen, (R_cw, t_cw) in zip(pictures, rig.project(points), rig.camera_poses(), strict=True):
        lower_px, upper_px, *dots_px = seen[:-1].reshape(-1, POINTS, 2)
        # the wall is seen where its outward normal faces the camera; the other half lies behind the disc
        facing = np.sum((lower - t + h * R[:, 2]) * (-R_cw.T @ t_cw - lower), axis=1) > 0
        start = int(np.argmin(facing))  # a hidden point, so that the visible ones are in one run
        visible = np.roll(facing, -start)
        _polylines(picture, [np.roll(lower_px, -start, axis=0)[visible]], "lower rim", closed=bool(facing.all()))
        _polylines(picture, [upper_px], "upper rim")
        _polylines(picture, dots_px, "dot")
        _cross(picture, seen[-1], "contact", cv2.MARKER_DIAMOND, 9)


def _polylines(picture: ColourImage, lines: Sequence[Array] | Array, colour: str, closed: bool = True) -> None:
    fine = 2**_SUBPIXEL_BITS * np.asarray(lines)
    finite: Mask = np.asarray(np.isfinite(fine).all(axis=2))  # not behind a camera, nor out of the lens's reach
    whole = np.rint(np.clip(np.where(finite[..., None], fine, 0.0), -(2**24), 2**24)).astype(np.int32)
    fixed = [line[seen, None] for line, seen in zip(whole, finite, strict=True) if seen.sum() > 1]
    if fixed:
        cv2.polylines(picture, fixed, closed, _COLOURS[colour], 1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _cross(picture: ColourImage, point: Array, colour: str, kind: int, size: int) -> None:
    if np.isfinite(point).all():
        x, y = np.clip(np.rint(point), -10000, 10000).astype(int)
        cv2.drawMarker(picture, (int(x), int(y)), _COLOURS[colour], kind, size, 1, cv2.LINE_AA)


@contextlib.contextmanager
def _encoder(path: Path, size: tuple[int, int]) -> Iterator[Callable[[ColourImage], object]]:
    """Function that appends one picture to an mp4 file: H.264 where PyAV is installed, MPEG-4 part 2 otherwise."""
    try:
        import av
    except ImportError:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), PLAYBACK_HZ, (size[1], size[0]))
        if not writer.isOpened():
            raise OutputError(
                f"{path}: this OpenCV cannot write mp4. Install PyAV: pip install disctrack[video]"
            ) from None
        try:
            yield lambda picture: writer.write(np.ascontiguousarray(picture))
        finally:
            writer.release()
        return
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=round(PLAYBACK_HZ), options={"preset": "ultrafast", "crf": "23"})
        stream.thread_count = 1  # more of them take a fifth more of a processor, and reading goes on beside
        stream.height, stream.width, stream.pix_fmt = size[0], size[1], "yuv420p"

        def write(picture: ColourImage) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")))

        yield write
        container.mux(stream.encode())
