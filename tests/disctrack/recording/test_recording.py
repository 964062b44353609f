"""recording.toml: what is read is what was declared, and whatever is wrong with it is said in one line."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from disctrack.errors import DiscTrackError, RecordingError
from disctrack.recording.declaration import KEYS, read_recording

REFERENCE = """
name = "clip"
[cameras]
frame_rate_hz = 1000.0
left = "left/*.png"
right = "right/*.png"
[disc]
radius_mm = 37.5
thickness_mm = 6
mass_g = 209.69
[markers]
diameter_mm = 7.0
centres_mm = [[26.0, 0.0], [13.0, 22.5167], [-13.0, 22.5167]]
[calibration]
left = "calibration/left/*.png"
right = "calibration/right/*.png"
inner_corners = [9, 6]
square_mm = 8.0
[table]
view = 0
board_thickness_mm = 3.0
[gravity]
g_m_s2 = 9.81
"""


NEEDED = [(section, key) for section, keys in KEYS.items() for key, meant in keys.items() if meant.needed]


def write(folder: Path, text: str | bytes) -> Path:
    (folder / "recording.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def message(folder: Path, text: str | bytes) -> str:
    with pytest.raises(RecordingError) as caught:
        read_recording(write(folder, text))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_lengths_and_masses_become_si(tmp_path):
    recording = read_recording(write(tmp_path, REFERENCE))
    disc, board, table = recording.disc, recording.chessboard, recording.table
    found = disc.radius, disc.half_thickness, disc.mass, *disc.marker_centres_body[0], board.square
    assert_allclose((*found, table.board_thickness), [0.0375, 0.003, 0.20969, 0.026, 0, 0.003, 0.008, 0.003])
    assert table.source == "both"
    assert recording.disc.thickness_tolerance is None  # not declared
    assert recording.board_tolerances.square is None


def test_every_key_of_the_reference_recording_is_known(shared_data):
    recording = read_recording(shared_data / "rec_a")
    assert recording.frame_rate == 1000.0
    assert recording.disc.n_markers == 6
    sections = {section: keys for section, keys in recording.declared.items() if isinstance(keys, dict)}
    assert set(NEEDED) == {(section, key) for section, keys in sections.items() for key in keys}


@pytest.mark.parametrize(
    ("air", "density"), [("", 1.2), ("[air]\npressure_hPa = 101.325\n", 0.12), ("[air]\ndensity_kg_m3 = 0.3\n", 0.3)]
)
def test_density_of_the_air_is_declared_or_follows_from_the_pressure(tmp_path, air, density):
    assert read_recording(write(tmp_path, REFERENCE + air)).air_density == pytest.approx(density)


def test_a_shared_rig_replaces_views_and_table(tmp_path):
    start, end = REFERENCE.index("[calibration]"), REFERENCE.index("[gravity]")
    text = REFERENCE[:start] + '[calibration]\nrig = "../rig.h5"\n' + REFERENCE[end:]
    recording = read_recording(write(tmp_path, text))
    assert recording.chessboard is None
    assert recording.rig_file == tmp_path / ".." / "rig.h5"
    assert recording.table is None


@pytest.mark.parametrize(("section", "key"), NEEDED)
def test_each_missing_key_is_named_with_its_section(tmp_path, section, key):
    lines = REFERENCE.splitlines()
    start = lines.index(f"[{section}]")
    dropped = next(i for i in range(start, len(lines)) if lines[i].startswith(key + " "))
    text = "\n".join(lines[:dropped] + lines[dropped + 1 :])
    assert re.search(rf"\[{section}\] {key} is missing", message(tmp_path, text))


def test_keys_that_init_leaves_open_are_named_at_once(tmp_path):
    text = "\n".join(line for line in REFERENCE.splitlines() if not line.startswith(("mass_g", "square_mm", "view")))
    assert re.search(r"\[disc\] mass_g, \[calibration\] square_mm, \[table\] view are missing", message(tmp_path, text))


@pytest.mark.parametrize("section", sorted({s for s, _ in NEEDED}))
def test_each_missing_section_is_named(tmp_path, section):
    before, _, after = REFERENCE.partition(f"[{section}]")
    assert f"section [{section}] is missing" in message(tmp_path, before + "".join(after.partition("\n[")[1:]))


@pytest.mark.parametrize(
    ("written", "found", "expected"),
    [
        ("radius_mm", "radus_mm", "unknown.*radius_mm"),
        ("frame_rate_hz", "framerate_hz", "unknown.*frame_rate_hz"),
        ("[gravity]", "[gravitiy]", "unknown.*gravity"),
        ("name =", "nane =", "unknown.*name"),
        ("mass_g = 209.69", "mass_g = 209.69\nframe_rate_hz = 5", "unknown.*'frame_rate_hz' of [cameras]"),
        ("square_mm = 8.0", "square_mm = 8.0\ntemperature = 20", "unknown.*Known here: left, right"),
        ("frame_rate_hz = 1000.0", f"frame_rate_hz = 1{'0' * 400}", "from 0.1 to 1e+07"),
        ("[cameras]", "[cameras]\nexposure_us = 1200", "exposure_us is 1200, longer than a frame: 1000 µs"),
        ("[gravity]", "[air]\npressure_hPa = 1\ndensity_kg_m3 = 1\n[gravity]", "both pressure_hPa and density_kg_m3"),
        ('left = "left/*.png"', "left = 3", "file pattern"),
        ("inner_corners = [9, 6]", "inner_corners = [9]", "two whole numbers"),
        ("inner_corners = [9, 6]", "inner_corners = 9", "two whole numbers"),
        ("[[26.0, 0.0], [13.0, 22.5167], [-13.0, 22.5167]]", "[[26.0, 0.0]]", "at least 3"),
        ("[[26.0, 0.0], [13.0, 22.5167]", "[[36.0, 0.0], [13.0, 22.5167]", "rim"),
        ("[[26.0, 0.0], [13.0, 22.5167]", "[[13.0, 22.0], [13.0, 22.5167]", "overlap"),
        ("square_mm = 8.0", 'square_mm = 8.0\nrig = "rig.h5"', "both rig and left, right"),
        ("[gravity]\n", "gravity = 9.81\n[other]\n", "unknown"),
        ("[[26.0, 0.0], [13.0, 22.5167], [-13.0, 22.5167]]", str([[0.01 * i, 1.0] for i in range(101)]), "at most 100"),
        ("frame_rate_hz = 1000.0", "frame_rate_hz = = 3", "line 4"),
        ("[table]", '[table]\nfrom = "rim"', '"board", "disc" or "both"'),
    ],
)
def test_what_is_wrong_is_shown_with_what_was_expected(tmp_path, written, found, expected):
    assert written in REFERENCE
    text = message(tmp_path, REFERENCE.replace(written, found, 1))
    assert all(part in text for part in expected.split(".*"))


ALL = [(s, key, meant.expected) for s, keys in KEYS.items() for key, meant in keys.items()]
NUMBERS = [(*at, *map(float, ends)) for *at, said in ALL for ends in re.findall(r" number from (\S+) to (\S+)$", said)]
CHARUCO = 'target = "charuco"\nsquares = [9, 6]\ndictionary = "4X4_50"'  # that marker_mm belongs to


@pytest.mark.parametrize(("section", "key", "least", "most"), NUMBERS)
def test_every_number_has_a_range_and_the_message_tells_it(tmp_path, section, key, least, most):
    text = re.sub(f"(?m)^{key} *=.*$", "", REFERENCE + "[air]\n")
    if key == "marker_mm":
        text = re.sub("(?m)^inner_corners.*$", CHARUCO, text)
    wrong = [repr(2 * most), repr(least - 1), "nan", "inf", "true", '"1"'] + (["1.5"] if key == "view" else [])
    for value in wrong:
        found = message(tmp_path, text.replace(f"[{section}]\n", f"[{section}]\n{key} = {value}\n"))
        assert f"{key} is {value.capitalize() if value == 'true' else value.replace(chr(34), chr(39))}" in found
        assert f"from {least:g} to {most:g}" in found


def test_without_a_declaration_it_is_said_what_a_recording_is(tmp_path):
    for folder in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(RecordingError, match=r"a folder with a recording\.toml"):
            read_recording(folder)


_values = st.recursive(
    st.one_of(
        st.booleans().map(lambda b: str(b).lower()),
        st.integers().map(str),
        st.floats().map(repr),
        st.text(st.characters(codec="ascii", categories=["L", "N"]), max_size=8).map(lambda s: f'"{s}"'),
    ),
    lambda children: st.lists(children, max_size=4).map(lambda items: f"[{', '.join(items)}]"),
    max_leaves=8,
)


@pytest.mark.statistical
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_value_at_any_key_is_read_or_refused_with_a_message(tmp_path, data):
    lines = REFERENCE.splitlines()
    number = data.draw(st.sampled_from([i for i, line in enumerate(lines) if "=" in line]))
    key = data.draw(st.one_of(st.just(lines[number].split("=")[0].strip()), st.sampled_from("abc")))
    lines[number] = f"{key} = {data.draw(_values)}"
    with contextlib.suppress(DiscTrackError):
        recording = read_recording(write(tmp_path, "\n".join(lines)))
        assert recording.frame_rate > 0
        assert np.isfinite(recording.disc.marker_centres_body).all()


def test_tolerances_exposure_and_source_of_the_table_may_be_declared(tmp_path):
    text = REFERENCE.replace("mass_g", "thickness_tolerance_mm = 0.02\nradius_tolerance_mm = 0\nmass_g", 1)
    text = text.replace("[table]", '[table]\nfrom = "disc"')
    read = read_recording(write(tmp_path, text.replace("[cameras]", "[cameras]\nexposure_us = 200")))
    assert read.exposure == pytest.approx(200e-6)
    assert (read.disc.thickness_tolerance, read.disc.radius_tolerance) == (pytest.approx(2e-5), 0.0)
    assert read.table.source == "disc"
