"""Faults that gave a result that looked good and was not: each is told, flagged or refused (docs/faults.md)."""

import errno
import os
import shutil
import tomllib
from dataclasses import fields, is_dataclass

import h5py
import numpy as np
import pytest

from disctrack.cli import main
from disctrack.errors import DiscTrackError, OutputError
from disctrack.files.toml_tree import toml_value
from disctrack.synthetic import recording as render_recording
from disctrack.synthetic.description import Scene
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import read_details, read_trajectory
from tests.pipeline.conftest import QUICK, contents, edit
from tests.rendering import SMALL_SCENE


def measured(recording, code: int = 0):
    """Trajectory and findings of a run that ends with this exit code."""
    assert main(["run", str(recording), *QUICK]) == code
    file = recording / "results" / "trajectory.h5"
    return read_trajectory(file), read_details(file)


def test_frames_missing_in_one_piece_are_lost_one_without_its_pair_is_not_and_time_goes_on(recording, untouched_file):
    untouched = read_trajectory(untouched_file)
    (recording / "right" / "000015.png").unlink()
    for camera in ("left", "right"):
        for i in (8, 9, 10):
            (recording / camera / f"{i:06d}.png").unlink()
    trajectory, findings = measured(recording, code=3)
    assert len(trajectory) == len(untouched)
    lost = np.flatnonzero(trajectory.frame_status == FrameStatus.UNREADABLE)
    assert list(lost) == [8, 9, 10]
    assert trajectory.frame_status[15] == FrameStatus.ONE_CAMERA
    assert (trajectory.coordinate_sigma[15, :3] > 3 * untouched.coordinate_sigma[15, :3]).all()
    after = np.r_[11:15, 16:24]
    apart = np.abs(trajectory.q[after] - untouched.q[after]) / untouched.coordinate_sigma[after]
    assert apart.max() < 1  # the shared refinement has three frames less; time itself must not move
    assert len(findings["unreadable"]) == 7
    measured(recording, code=3)  # reused, and still incomplete


OURS = ("left/000003.png", "recording.toml", "rig.h5")


@pytest.mark.parametrize(
    ("command", "target"),
    [
        *(("track", target) for target in (*OURS, "link.h5", "hard.h5", "views/../right/000001.png")),
        *(("calibrate", target) for target in OURS),  # of a recording that this command does not read
    ],
)
def test_no_output_replaces_an_input(recording, rig_file, short_recording, cli, command, target):
    shutil.copy(rig_file, recording / "rig.h5")
    (recording / "views").mkdir()
    (recording / "link.h5").symlink_to(recording / "rig.h5")
    os.link(recording / "rig.h5", recording / "hard.h5")
    edit(recording, rig_file.as_posix(), "rig.h5")
    before = contents(recording)
    source = recording if command == "track" else short_recording
    words = [command, source, "-o", recording / target, "--overwrite", "--no-figures"]
    said = cli(*words, *(["--no-video"] if command == "track" else []), code=1).err
    assert "no output replaces an input" in said
    assert contents(recording) == before


def test_a_scene_or_a_model_is_not_replaced_by_what_is_made_of_it(tmp_path, cli):
    scene = tmp_path / "scene.toml"
    scene.write_text(cli("render", "--defaults").out.replace('kind = "steady"', 'kind = "rolling"'))
    before = scene.read_bytes()
    said = cli("simulate", scene, "-o", scene, "--overwrite", "--duration", "0.01", code=1).err
    assert "no output replaces an input" in said
    assert scene.read_bytes() == before


def test_rendering_leaves_a_folder_alone_that_looks_like_a_remainder(tmp_path, monkeypatch):
    mine = tmp_path / "take.part"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")

    def full(scene):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(render_recording, "recording_toml", full)
    with pytest.raises(OutputError, match="disk full"):
        render_recording.run_render(Scene(), tmp_path / "take")
    assert contents(tmp_path) == {"take.part/notes.txt": b"mine"}


SPOILT = {
    "x is 1e+300": lambda file: file["x"].__setitem__(7, 1e300),
    "z is -inf": lambda file: file["z"].__setitem__(7, -np.inf),
    "time does not increase": lambda file: file["time"].__setitem__(7, 0.0),
    "not positive definite": lambda file: file["pose_covariance"].__setitem__(7, 0.0),
    "unknown status 77": lambda file: file["status"].__setitem__(7, 77),
    "no rotation": lambda file: file["quaternion"].__setitem__(7, 0.0),
    "expected 'm'": lambda file: file["x"].attrs.__setitem__("units", "mm"),
    "have a pose": lambda file: [file[name].__setitem__(..., np.nan) for name in ("x", "psi")],
    "at rest": lambda file: [
        file[name].__setitem__(..., file[name][0]) for name in ("x", "y", "z", "psi", "theta", "phi", "quaternion")
    ],
}


@pytest.mark.parametrize("said", SPOILT)
@pytest.mark.parametrize("command", ["analyse", "diagnose"])
def test_a_value_that_is_no_measurement_is_told_in_a_sentence(untouched_file, tmp_path, cli, command, said):
    if (command, said) == ("analyse", "at rest"):
        pytest.skip("the physics of a disc at rest can be told")
    file = shutil.copy(untouched_file, tmp_path / "trajectory.h5")
    with h5py.File(file, "r+") as handle:
        SPOILT[said](handle)
    errors = cli(command, file, code=1).err
    assert "internal error" not in errors
    assert said.split(" is ")[0] in errors or command == "diagnose"


def test_a_table_view_below_zero_is_no_view(short_recording, tmp_path, cli):
    views = [str(short_recording / "calibration" / camera / "*.png") for camera in ("left", "right")]
    words = ["--left", views[0], "--right", views[1], "--corners", "9x6", "--square-mm", "6", "--table-view=-1"]
    assert "view = -1" in cli("calibrate", *words, "-o", tmp_path / "rig.h5", code=1).err


def numbers_in(file) -> list[str]:
    """Names of the data sets that hold floating-point numbers."""
    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    return [name for name in found if file[name].dtype.kind == "f"]


VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 5e-324, 1e6)


@pytest.mark.parametrize("n", [15, pytest.param(400, marks=pytest.mark.slow)])
def test_random_values_in_a_trajectory_file_end_in_a_result_or_a_sentence(untouched_file, tmp_path, n):
    """The reader lets pass what can be worked with; every damage is one value, or a run of them, anywhere."""
    rng = np.random.default_rng(14)
    for _ in range(n):
        file = shutil.copy(untouched_file, tmp_path / "trajectory.h5")
        with h5py.File(file, "r+") as handle:
            names = numbers_in(handle)
            item = handle[names[rng.integers(len(names))]]
            values = item[...].reshape(-1)
            if not values.size:
                continue
            start = int(rng.integers(values.size))
            values[start : start + int(rng.choice([1, 1, 6, values.size]))] = rng.choice(VALUES)
            item[...] = values.reshape(item.shape)
        try:
            trajectory = read_trajectory(file)
        except DiscTrackError:
            continue
        assert (np.diff(trajectory.time) > 0).all()
        assert (np.abs(trajectory.q[trajectory.measured]) < 1e7).all()


COMMANDS = ("run", "track", "analyse", "calibrate", "simulate", "render")
WORDS = ("-o", "--frames", "--overwrite", "-1", "9x6", "nan", "1e400", "--threads", "--corners")
WORDS += ("--square-mm", "::", "\0", "../..", "nowhere", "--rig", "é", "")


@pytest.mark.parametrize("n", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_random_command_lines_end_with_an_exit_code_and_no_internal_error(tmp_path, monkeypatch, capsys, n):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(41)
    for _ in range(n):
        words = [str(rng.choice(COMMANDS)), *(WORDS[i] for i in rng.integers(0, len(WORDS), rng.integers(0, 6)))]
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code
        assert code in (0, 1, 2), (words, capsys.readouterr().err)


COUNTS = {"n_frames", "n_views", "subpixels", "threads"}  # large ones are lawful, and only take long
WRONG_KINDS = ("word", True, [], [[]], [1.0], "", "\0", {})


def leaves(item, path=()):
    """Keys of a scene, with their defaults."""
    for entry in fields(item):
        value = getattr(item, entry.name)
        if is_dataclass(value):
            yield from leaves(value, (*path, entry.name))
        elif entry.name != "folder":
            yield (*path, entry.name), value


def some_value(rng, key, like):
    """A value in place of one like this: another number, or numbers, or a thing of another kind."""
    if rng.random() < 0.1:
        return WRONG_KINDS[rng.integers(len(WRONG_KINDS))]
    if isinstance(like, tuple) and like:
        at = int(rng.integers(len(like)))
        return [some_value(rng, key, entry) if i == at else entry for i, entry in enumerate(like)]
    if isinstance(like, bool) or not isinstance(like, int | float):
        return WRONG_KINDS[rng.integers(len(WRONG_KINDS))]
    if isinstance(like, int):
        return int(rng.choice([-1, 0, 1, 2, 7] if key in COUNTS else [-(10**9), -1, 0, 1, 2, 7, 65, 10**9]))
    return float(rng.choice([*VALUES, 1e-3, 0.5, 2.0, -2.0, 1e3]) if rng.random() < 0.7 else like * rng.normal(1, 3))


@pytest.mark.statistical
@pytest.mark.parametrize("n", [12, pytest.param(500, marks=pytest.mark.slow)])
def test_random_scenes_end_in_a_recording_or_a_sentence(tmp_path, capsys, n):
    """One or two values of a small scene are replaced; what is rendered has its truth in numbers."""
    rng = np.random.default_rng(1414)
    keys = list(leaves(Scene()))
    for i in range(n):
        lines = tomllib.loads(SMALL_SCENE.format(kind=rng.choice(["static", "rolling"])))
        for j in rng.integers(0, len(keys), rng.integers(1, 3)):
            path, default = keys[j]
            part = lines
            for name in path[:-1]:
                part = part.setdefault(name, {})
            part[path[-1]] = some_value(rng, path[-1], default)
        scene, out = tmp_path / f"{i}.toml", tmp_path / f"{i}"
        scene.write_text("\n".join(f"{name} = {toml_value(value)}" for name, value in lines.items()))
        code = main(["render", str(scene), "-o", str(out), "--truth", str(tmp_path / f"{i}.h5"), "--quiet"])
        said = capsys.readouterr().err
        assert code in (0, 1), (scene.read_text(), said)
        assert "internal error" not in said, (scene.read_text(), said)
        if code == 0:
            with h5py.File(tmp_path / f"{i}.h5") as truth:
                assert np.isfinite(truth["q"]).all(), scene.read_text()
            shutil.rmtree(out)
