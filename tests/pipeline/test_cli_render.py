"""`disctrack render` from the command line."""

from dataclasses import replace
from pathlib import Path

from disctrack.cli import main
from disctrack.recording.declaration import read_recording
from disctrack.synthetic import read_truth
from disctrack.synthetic.description import Scene, load_scene

SCENE = """
name = "tiny"
[cameras]
image_size = [128, 128]
[rig]
mm_per_px = 1.0
[board]
n_views = 2
[motion]
poses = [[32, 20, 12, 30, 15, 40], [32, 20, 12, 60, 15, 40]]
"""


def test_render_writes_a_recording_and_its_truth_apart(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    folder, truth = tmp_path / "out", tmp_path / "truth.h5"
    assert main(["render", str(tmp_path / "scene.toml"), "-o", str(folder), "--truth", str(truth), "--quiet"]) == 0
    assert read_recording(folder).name == "tiny"
    assert len(read_truth(truth).time) == 2
    assert not (folder / "truth.h5").exists()
    assert "left 2, right 2 images" in capsys.readouterr().out


def test_render_does_not_overwrite_and_names_a_wrong_key(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine").touch()
    assert main(["render", str(tmp_path / "scene.toml"), "--quiet"]) == 1
    assert "not an empty folder" in capsys.readouterr().err
    (tmp_path / "wrong.toml").write_text("[cameras]\nframes = 3\n")
    assert main(["render", str(tmp_path / "wrong.toml"), "--quiet"]) == 1
    assert "nearest known key is 'n_frames'" in capsys.readouterr().err


def test_printed_defaults_are_the_default_scene(tmp_path, capsys):
    assert main(["render", "--defaults"]) == 0
    (tmp_path / "scene.toml").write_text(capsys.readouterr().out)
    read = replace(load_scene(tmp_path / "scene.toml"), folder=Path())
    assert repr(read) == repr(Scene())  # to the last bit, and nan is nan
