"""Settings survive their TOML, whatever they hold."""

import tomllib

import numpy as np
import pytest

from disctrack.errors import RecordingError
from disctrack.faults.keys import Faults, Occluder
from disctrack.files.toml_tree import build, read_toml, toml_lines, toml_value
from disctrack.synthetic.description import CameraSettings, MarkerSettings, MotionSettings, RollingMotion, Scene


@pytest.mark.parametrize(
    "title", ["", 'a "b" \\ c', "ψ̇ µm", "disc \U0001d703 \U0001f4bf", "tab\tline\nend\x00\x1f\x7f"]
)
def test_settings_survive_their_text(title):
    settings = Scene(
        title, cameras=CameraSettings(frame_rate_hz=float(np.float64(0.1))),
        markers=MarkerSettings(centres_mm=((1.0, 1e7), (-0.0, 1e-300))),
        motion=MotionSettings(rolling=RollingMotion(effects={title or "k": {"k": 2.0}})),
        faults=Faults(occluders=(Occluder(), Occluder(last_frame=7))),
    )  # fmt: skip
    assert repr(build(Scene, tomllib.loads("\n".join(toml_lines(settings))), "test")) == repr(settings)  # nan is nan


def test_numbers_of_numpy_are_numbers():
    values = [np.float64(0.1), np.float32(2.0), np.int64(3), np.bool_(True), np.array([1.5, np.nan])]
    text = toml_value(values)
    again = tomllib.loads(f"a = {text}")["a"]
    assert again[:4] == [0.1, 2.0, 3, True]
    assert again[4][0] == 1.5
    assert np.isnan(again[4][1])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a = ", "not valid TOML"),
        (b"[disc]\nradius_mm = 37,5\n", r"line 2, column 15\): radius_mm = 37,5. Correct.* Numbers have a point"),
        (b'left = "left\\*.png"', "Folders are divided by /"),
        (b"a = '\xff'", "byte 0xff in position 5.*in UTF-8"),
        (b"a = " + b"[" * 100_000, "recursion"),
        (b"a = " + b"1" * 10_000, "integer string conversion"),
    ],
)
def test_a_file_that_is_no_toml_is_named_with_the_reason(tmp_path, content, message):
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f"settings.toml: .*{message}"):
        read_toml(path, RecordingError)
    with pytest.raises(RecordingError, match=r"nowhere\.toml: cannot be read"):
        read_toml(tmp_path / "nowhere.toml", RecordingError)
