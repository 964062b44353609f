"""Where the motion starts and ends: real motion is never cut, rest is, and noise and light are no motion."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from disctrack.errors import RecordingError
from disctrack.track.follow.motion_span import MARGIN, STRIDE, find_motion, still_scene

RATE = 200.0  # [Hz] so that the margin is 50 frames
MARGIN_FRAMES = round(MARGIN * RATE)
SIZE = 128
DOTS = np.array([[18.0, 0.0], [-9.0, 15.6], [-9.0, -15.6], [8.0, 9.0]])


class DrawnCamera:
    """Frames of a disc with four dots at place(i) [px], drawn when asked for; None: no disc."""

    def __init__(self, place, seed: int, brightness: Callable[[int], float] = lambda i: 1.0, broken=()) -> None:
        self.place, self.seed, self.brightness, self.broken = place, seed, brightness, broken
        self.read_frames: list[int] = []

    def read(self, index: int, out=None):
        self.read_frames.append(index)
        if index in self.broken:
            raise RecordingError(f"frame {index} is broken")
        scale = 8  # subpixels: edges move by an eighth of a pixel and less after the blur
        image = np.full((SIZE * scale, SIZE * scale), 60, np.uint8)
        pose = self.place(index)
        if pose is not None:
            x, y, turn = pose
            c, s = np.cos(turn), np.sin(turn)
            discs = [((x, y), 34, 190), *(((x + c * u - s * v, y + s * u + c * v), 5, 40) for u, v in DOTS)]
            for (u, v), radius, grey in discs:
                centre = round(16 * scale * (u + 0.5)), round(16 * scale * (v + 0.5))
                cv2.circle(image, centre, round(16 * scale * radius), grey, -1, cv2.LINE_AA, 4)
        grey = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(grey.astype(float), (0, 0), 0.8) * self.brightness(index)
        noise = np.random.default_rng([self.seed, index]).standard_normal(grey.shape)
        return np.clip(np.round(grey + noise * np.sqrt(0.5 + grey / 50)), 0, 255).astype(np.uint8)


def cameras(place, **light):
    return DrawnCamera(place, 1, **light), DrawnCamera(place, 2, **light)


def rest_motion_rest(begin, end, speed):
    """Position that rests, moves at `speed` px per frame between two instants, and rests."""
    return lambda i: (60.0 + speed * (np.clip(i, begin, end) - begin), 64.0, 0.3)


def found_in(n, place, **light):
    return find_motion(*cameras(place, **light), 0, n, RATE)


@pytest.mark.parametrize("speed", [0.1, 1.0])
def test_rest_at_both_ends_is_left_out_and_all_motion_is_kept(speed):
    begin, end = 303, 303 + round(8 / speed)
    n = end + 290
    span = found_in(n, rest_motion_rest(begin, end, speed))
    # everything that moves and most of the margin is there; no more than a look's distance is kept beside it
    assert begin - MARGIN_FRAMES - 2 * STRIDE <= span.start <= begin - MARGIN_FRAMES + STRIDE
    assert end + MARGIN_FRAMES - STRIDE <= span.stop <= end + MARGIN_FRAMES + 2 * STRIDE
    assert "rest in frames 0-" in span.verdict
    assert span.looked_at < n / 8


def test_a_slow_start_is_kept_from_before_it_can_be_seen():
    """Speed grows evenly to 0.1 px per frame within 200 frames: at first the disc creeps by 2.5e-4 px."""
    start, ramp = 400, 200

    def place(i):
        t = np.clip(i - start, 0, ramp)
        return 55.0 + 0.5 * (0.1 / ramp) * t**2 + 0.1 * max(0, min(i, 700) - start - ramp), 64.0, 0.0

    span = found_in(1000, place)
    moved = np.array([abs(place(i)[0] - 55.0) for i in range(1000)])
    assert start - MARGIN_FRAMES - STRIDE <= span.start
    assert moved[span.start] == 0.0  # what is cut has not moved at all
    assert abs(place(span.stop)[0] - place(999)[0]) == 0.0


@pytest.mark.parametrize(
    ("n", "begin", "end", "place", "brightness"),
    [
        (700, 250, 400, lambda i: (64.0, 64.0, 0.02 * np.clip(i - 250, 0, 150)), lambda i: 1.0),
        # one turn in STRIDE frames: looks at regular distances would see a still disc
        (600, 200, 392, lambda i: (64, 64, 2 * np.pi * np.clip(i - 200, 0, 12 * STRIDE) / STRIDE), lambda i: 1.0),
        (900, 250, 601, lambda i: (64.0, 64.0, 0.05 * i) if 250 <= i <= 600 else None, lambda i: 1.0),
        (800, 350, 430, rest_motion_rest(350, 430, 0.2), lambda i: 1 + 0.03 * np.sin(0.7 * i)),
    ],
    ids=["spins in place", "turns in step with the looks", "put there and taken away", "light flickers"],
)
def test_all_that_moves_is_kept_and_light_is_no_motion(n, begin, end, place, brightness):
    span = found_in(n, place, brightness=brightness)
    assert begin - MARGIN_FRAMES - 2 * STRIDE <= span.start <= begin
    assert end <= span.stop <= end + MARGIN_FRAMES + 2 * STRIDE


@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_a_pause_in_the_middle_stays_and_where_nothing_moves_all_is_kept(speed):
    moves = lambda i: speed * (np.clip(i, 20, 60) + np.clip(i, 640, 680) - 660)  # noqa: E731
    span = found_in(700, lambda i: (50.0 + moves(i), 64.0, 0.0))
    assert (span.start, span.stop) == (0, 700)
    assert span.verdict == ("moves from end to end" if speed else "nothing moves in the whole recording")


def test_motion_from_end_to_end_costs_a_few_looks_and_nothing_is_left_out():
    left, right = cameras(lambda i: (64.0 + 20 * np.sin(0.05 * i), 64.0, 0.1 * i))
    span = find_motion(left, right, 0, 2000, RATE)
    assert (span.start, span.stop) == (0, 2000)
    assert span.looked_at == len(left.read_frames) <= 8
    assert span.verdict == "moves from end to end"


def test_frames_that_cannot_be_read_are_passed_over():
    broken = {0, 1, 7, *range(100, 180), 798, 799}
    span = found_in(800, rest_motion_rest(350, 430, 0.2), broken=broken)
    assert span.start <= 350 <= 430 <= span.stop
    assert found_in(800, rest_motion_rest(350, 430, 0.2), broken=set(range(800))).stop == 800


def test_a_scene_tells_a_fifth_of_a_pixel_from_noise_and_noise_from_motion():
    still = DrawnCamera(lambda i: (64.0, 64.0, 0.0), 1)
    moved = DrawnCamera(lambda i: (64.25, 64.0, 0.0), 1)  # drawn in steps of an eighth
    differs = still_scene(still.read(0), still.read(1))
    assert not any(differs(still.read(i)) for i in range(2, 60))
    assert all(differs(moved.read(i)) for i in range(2, 20))


def test_rest_seen_by_a_quiet_camera_is_rest_in_any_unit_of_grey(rng):
    """Rounding is all the noise there is: single steps of the grey value, whatever they are called in the file."""
    y, x = np.mgrid[:SIZE, :SIZE]
    scene = 60 + 100 / (1 + np.exp((np.hypot(x - 64, y - 64) - 34) / 1.2)) + 0.1 * x
    rest = [np.rint(scene + 0.15 * rng.standard_normal(scene.shape)).astype(np.uint8) for _ in range(6)]
    moved = np.roll(rest[5], 2, axis=1)
    for scale in (1, 16, 257):
        differs = still_scene(*(image.astype(np.uint16) * np.uint16(scale) for image in rest[:2]))
        assert not any(differs(image.astype(np.uint16) * np.uint16(scale)) for image in rest[2:])
        assert differs(moved.astype(np.uint16) * np.uint16(scale))
