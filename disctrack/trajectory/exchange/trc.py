"""A trajectory as a TRC file: the points of motion capture that OpenSim and Pose2Sim read.

OpenSim's axes are y up: written are (Y, Z, X) of the world, as Pose2Sim turns them. Empty where there is none.
"""

from pathlib import Path

import numpy as np

from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import body_points


def write_trc(path: Path, trajectory: Trajectory) -> None:
    """Centre, tips of the body axes and dots in metres. Raises OutputError."""
    points, labels = body_points(trajectory)
    n, k, rate = len(points), len(labels), f"{trajectory.frame_rate:g}"
    heads = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{k}\tm\t{rate}\t{trajectory.frame[0]}\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, k + 1)),
        "",
    ]
    rows = [
        f"{frame}\t{time:.9g}\t" + "\t".join("" if np.isnan(v) else f"{v:.9f}" for v in row)
        for frame, time, row in zip(
            trajectory.frame, trajectory.time, points[..., [1, 2, 0]].reshape(n, -1), strict=True
        )
    ]
    write_whole(path, ("\n".join((*heads, *rows)) + "\n").encode())
