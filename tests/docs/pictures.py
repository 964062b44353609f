"""The pictures of the documentation, from the sample data and a rendered recording.

python tests/docs/pictures.py CLIP SECRET [FOLDER]

CLIP : results of `disctrack run` of sample_data/clip; SECRET : of the tour, diagnosed with --figures;
FOLDER : where the pictures go (default: `disctrack/docs/pictures`)
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

import disctrack
from disctrack.report.figures import panels, save_figure
from disctrack.report.palette import BLUE, INK
from disctrack.track.video_overlay import draw_pair

FRAME = 60
WIDTH = 900  # px of the copied figures: enough for a page, small enough for a repository


def theta_figure(trajectory: disctrack.Trajectory) -> Figure:
    """Nutation over time; below, what remains of it after a smooth curve, with the band of one sigma."""
    figure, (upper, lower) = panels(7.6, 4.2, 2, sharex=True, height_ratios=(2, 1))
    time, theta = trajectory.time, np.degrees(trajectory.q[:, 4])
    sigma = 1e3 * np.degrees(trajectory.coordinate_sigma[:, 4])
    smooth = disctrack.differentiate(trajectory).euler[:, 1]
    rest = 1e3 * (theta - np.degrees(smooth))
    upper.plot(time, theta, color=INK, linewidth=1.1)
    upper.set_ylabel("nutation θ (deg)")
    lower.fill_between(time, -sigma, sigma, color=BLUE, alpha=0.3, linewidth=0)
    lower.plot(time, rest, ".", color=INK, markersize=2)
    lower.set(ylabel="θ − smooth (mdeg)", xlabel="time (s)")
    return figure


def make(clip: Path, secret: Path, folder: Path) -> list[Path]:
    """Write all pictures."""
    trajectory = disctrack.read_trajectory(clip / "trajectory.h5")
    pairs = disctrack.open_pairs(disctrack.read_recording("sample_data/clip"))
    images = np.stack([pairs.left.read(FRAME), pairs.right.read(FRAME)])
    drawn = cv2.resize(draw_pair(images, trajectory, FRAME), None, fx=1.8, fy=1.8, interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "frame.png"), drawn)
    written = [folder / "frame.png", save_figure(theta_figure(trajectory), folder / "theta.png")]
    copies = {
        "calibration_residuals.png": secret / "calibration_residuals.png",
        "coordinates.png": secret / "coordinates.png",
        "check.jpg": secret / "check.png",
        "diagnosis_residuals.png": secret / "trajectory_diagnosis" / "figures" / "02_residuals.png",
        "diagnosis_free_run.png": secret / "trajectory_diagnosis" / "figures" / "04_free_run.png",
        "diagnosis_candidates.png": secret / "trajectory_diagnosis" / "figures" / "07_candidates.png",
    }
    for name, source in copies.items():
        picture = cv2.imread(str(source))
        scale = min(1.0, WIDTH / picture.shape[1])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        quality = [cv2.IMWRITE_JPEG_QUALITY, 82] if name.endswith("jpg") else [cv2.IMWRITE_PNG_COMPRESSION, 9]
        cv2.imwrite(str(folder / name), small, quality)
        written.append(folder / name)
    return written


if __name__ == "__main__":
    target = Path(sys.argv[3]) if len(sys.argv) > 3 else Path("disctrack/docs/pictures")
    for file in make(Path(sys.argv[1]), Path(sys.argv[2]), target):
        print(file, file.stat().st_size // 1000, "kB")
