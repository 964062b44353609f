"""Speed of the measurement beside other ways of looking at the same frames, as ratios within one run.

    pytest -m slow -p benchmark --dist=no tests/benchmarks/bench_tracking.py --benchmark-timer=time.process_time

A round is all pairs. The two limits do what nobody can spare: read every byte, and compute with the pixels of the dots.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numba
import numpy as np
import pytest
from scipy.optimize import least_squares

from calibration import StereoRig
from disctrack import Recording, Trajectory, measure, measure_pairs
from disctrack.frames import rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from disctrack.track.measurement import ImagePairs

# Counted in track/dots/_kernels.py: +, -, *, / and roots for a pixel of a dot, each time its model and the normal
# equations are evaluated (edge distance 40, profile 25, model and derivatives 55, sums 90); and how often that is.
OPERATIONS, EVALUATIONS = 210, 4
ROUNDS = 5

pytestmark = [pytest.mark.slow, pytest.mark.benchmark(group="all pairs of the recording")]


@pytest.fixture(scope="session")
def trajectory(images: np.ndarray, rig: StereoRig, recording: Recording) -> Trajectory:
    """Where the dots are; compiles."""
    return measure_pairs(images, rig, recording.disc, recording.frame_rate).trajectory


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.usefixtures("trajectory")
def test_measured_from_memory(benchmark, images, rig, recording, threads: int) -> None:
    given = images, rig, recording.disc, recording.frame_rate
    benchmark.pedantic(measure_pairs, given, {"threads": threads}, rounds=ROUNDS)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.usefixtures("trajectory")
def test_measured_from_files(benchmark, pairs: ImagePairs, rig, recording, threads: int) -> None:
    benchmark.pedantic(measure, (recording, rig, pairs), {"threads": threads}, rounds=ROUNDS)


@pytest.mark.parametrize("threads", [1, 2])
def test_decoding_alone(benchmark, pairs: ImagePairs, threads: int) -> None:
    names = [str(reader.files[i]) for i in range(len(pairs)) for reader in (pairs.left, pairs.right)]

    def decode() -> None:
        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(lambda name: cv2.imread(name, cv2.IMREAD_UNCHANGED), names):
                pass

    benchmark.pedantic(decode, rounds=ROUNDS)


def test_read_alone(benchmark, pairs: ImagePairs, images: np.ndarray) -> None:
    def read() -> None:
        for i, pair in enumerate(images.copy()):
            pairs.left.read(i, pair[0])
            pairs.right.read(i, pair[1])

    benchmark.pedantic(read, rounds=ROUNDS)


def test_limit_of_memory(benchmark, images: np.ndarray) -> None:
    target = images.copy()
    benchmark.pedantic(np.copyto, (target, images), rounds=ROUNDS)


def test_limit_of_arithmetic(benchmark, images, trajectory: Trajectory) -> None:
    values = np.ones(2048, np.float32)  # stay in the nearest cache
    multiplied_and_added(values, 1)
    operations = len(images) * dot_pixels(trajectory) * OPERATIONS * EVALUATIONS
    benchmark.pedantic(multiplied_and_added, (values, int(operations / (2 * len(values)))), rounds=ROUNDS)


@numba.njit(fastmath=True)
def multiplied_and_added(values: np.ndarray, rounds: int) -> None:
    """Single precision, two operations a value and round."""
    a, b = np.float32(0.999), np.float32(1e-3)
    for _ in range(rounds):
        for i in range(values.size):
            values[i] = values[i] * a + b


def dot_pixels(trajectory: Trajectory) -> float:
    """Pixels of the windows of a pair's dots, all cameras; the median of the frames."""
    disc, rig = trajectory.disc, trajectory.rig
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    circle = 0.5 * disc.marker_diameter * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    found = []
    for row in np.flatnonzero(trajectory.measured)[::10]:
        R, t = rotation_from_quaternion(trajectory.quaternion[row]), trajectory.q[row, :3]
        seen = rig.project(((disc.marker_centres_body[:, None] + circle) @ R.T + t).reshape(-1, 3))
        size = np.ptp(seen.reshape(2, disc.n_markers, len(angle), 2), axis=2) + 2 * 6  # px of a window beyond the rim
        found.append(np.nansum(size.prod(axis=-1)))
    return float(np.median(found))


def test_plain_opencv_and_scipy(benchmark, images, rig, recording, trajectory: Trajectory) -> None:
    """What one writes in an afternoon: threshold, contours, moments, least squares per frame; start pose given."""
    R = rotation_from_quaternion(trajectory.quaternion[0])
    start = np.concatenate([trajectory.q[0, :3], vector_from_rotation(R)])
    centres = recording.disc.marker_centres_body

    def projected(pose: np.ndarray) -> np.ndarray:
        return rig.project(centres @ rotation_from_vector(pose[3:]).T + pose[:3])

    poses = benchmark.pedantic(plain_poses, (images, projected, start), rounds=1)
    measured = trajectory.measured & np.isfinite(poses[:, 0])
    assert np.median(np.abs(poses - trajectory.q)[measured, :3]) < 1e-4  # it follows the same disc


def plain_poses(images: np.ndarray, projected: Callable[[np.ndarray], np.ndarray], pose: np.ndarray) -> np.ndarray:
    poses = np.full((len(images), 6), np.nan)
    velocity = np.zeros(6)
    for i, pair in enumerate(images):
        expected = projected(pose + velocity)
        observed = np.full_like(expected, np.nan)
        for camera, image in enumerate(pair):
            blobs = dark_blobs(image)
            if len(blobs):
                distance = np.linalg.norm(expected[camera][:, None] - blobs, axis=-1)
                nearest = distance.argmin(axis=1)
                close = distance.min(axis=1) < 8
                observed[camera][close] = blobs[nearest[close]]
        seen = np.isfinite(observed)
        if seen.sum() < 6:
            continue
        fit = least_squares(lambda p, o=observed, s=seen: (projected(p) - o)[s], pose + velocity)
        velocity = fit.x - pose if i else velocity
        pose = poses[i] = fit.x
    return poses


def dark_blobs(image: np.ndarray) -> np.ndarray:
    """Centres (n, 2) of what may be dots."""
    _, dark = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    moments = [m for m in map(cv2.moments, contours) if 50 < m["m00"] < 5000]
    return np.array([(m["m10"] / m["m00"], m["m01"] / m["m00"]) for m in moments])
