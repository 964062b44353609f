"""Synthetic recordings with known truth: what the two cameras would see, down to photons and quantisation.

cameras (true rig, board poses) -> optics (rays, blur, lamp), raster (shapes) -> sensor (noise, numbers)
-> images (disc, chessboard) -> recording (folder) and truth (truth.h5).
It shares no code with the location of markers and corners, so that those can be judged by it.
"""

from disctrack.synthetic.cameras import board_poses, rig_after_faults, rig_of
from disctrack.synthetic.recording import recording_toml, run_render, true_disc_of, write_recording
from disctrack.synthetic.truth import Truth, read_truth

__all__ = [
    "Truth",
    "board_poses",
    "read_truth",
    "recording_toml",
    "rig_after_faults",
    "rig_of",
    "run_render",
    "true_disc_of",
    "write_recording",
]
