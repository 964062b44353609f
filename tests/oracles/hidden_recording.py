"""Recordings in images of a motion that the product's equations have no part in, with an effect that nobody declares.

The motion is that of world vectors and quaternions (newton_euler), integrated by a multistep method; the calibration is
that of rendered chessboard views, with the error that their noise brings. What was hidden is written elsewhere.
"""

import json
from dataclasses import replace

import numpy as np

from disctrack.faults.keys import Faults
from disctrack.synthetic.description import BoardSettings, CameraSettings, MotionSettings, RigSettings, Scene
from disctrack.synthetic.motion import SceneMotion
from disctrack.synthetic.recording import write_recording
from tests.oracles import newton_euler

K_M = 0.381e-7
LEAD = 0.005  # [s] of motion before the first frame
SAMPLES = 8  # of the motion per frame; the cubic between them errs by 1e-4 of the noise


def small_scene(seed: int, n_frames: int, frame_rate: float) -> Scene:
    """A quarter of the pixels and few chessboard views."""
    return Scene(
        name="hidden",
        seed=seed,
        cameras=CameraSettings(image_size=(272, 272), frame_rate_hz=frame_rate, n_frames=n_frames),
        rig=RigSettings(mm_per_px=0.42),
        board=BoardSettings(n_views=12, square_mm=6.0, shift_mm=15.0),
        motion=MotionSettings(kind="table"),
    )


def full_scene(seed: int, n_frames: int, frame_rate: float) -> Scene:
    """The paper's format."""
    scene = Scene(name="hidden", seed=seed, motion=MotionSettings(kind="table"))
    return replace(scene, cameras=CameraSettings(frame_rate_hz=frame_rate, n_frames=n_frames))


def true_motion(body: newton_euler.Disc, theta_deg: float, omega3: float, duration: float, rate: float) -> SceneMotion:
    """Rolling from a precession near the steady one: the difference is the nutation."""
    theta = np.radians(theta_deg)
    omega2 = np.sqrt(4 * 9.81 * np.sin(theta) / body.r)  # thin disc, centre at rest
    state = newton_euler.state_from_angles(body, 0.032, 0.02, 0.7, theta, -0.4, 0.0, omega2, omega3)
    times = np.arange(0.0, duration + 2 * LEAD, 1.0 / (SAMPLES * rate))
    if body.gives_way:
        body.table = newton_euler.yielding(body, state, times)
        state = newton_euler.state_from_angles(body.at(0.0), 0.032, 0.02, 0.7, theta, -0.4, 0.0, omega2, omega3)
    answer = newton_euler.follow(body, state, times, rtol=1e-10, atol=1e-11, method="LSODA")
    assert answer.success
    spline = newton_euler.course(body, times - LEAD, answer.y)
    return SceneMotion(spline, spline.derivative(), int(duration * rate))


def hide(
    folder,
    *,
    scene: Scene,
    body: newton_euler.Disc,
    theta_deg: float = 14.0,
    omega3: float = 1.5,
    faults: Faults | None = None,
    note: str = "",
):
    """Render into folder/recording; folder/elsewhere holds the truth. Returns the recording's folder."""
    scene = replace(scene, faults=faults or Faults())
    rate, n = scene.cameras.frame_rate_hz, scene.cameras.n_frames
    motion = true_motion(body, theta_deg, omega3, n / rate, rate)
    write_recording(folder / "recording", scene, motion, truth_path=folder / "elsewhere" / "truth.h5")
    (folder / "elsewhere" / "hidden.json").write_text(json.dumps({"hidden": note}))
    return folder / "recording"


def body_of(scene: Scene, **changes) -> newton_euler.Disc:
    """The declared disc with the paper's friction, and whatever is changed in it; `laws` come on top."""
    disc = scene.declared_disc
    laws = (newton_euler.precession_friction(K_M), *changes.pop("laws", ()))
    return newton_euler.Disc(disc.radius, disc.half_thickness, disc.mass, laws=laws, **changes)
