"""The page to play with: right numbers, nothing from outside, and drawn by a real browser without an error."""

import json
import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest

import disctrack
from disctrack.analyse.analysis import analyse
from disctrack.analyse.motion_page import motion_html
from disctrack.track.video_overlay import draw_pair
from tests.pipeline.conftest import images_of


@pytest.fixture(scope="module")
def measured(sample_clip, rig_file):
    """Trajectory of some frames, its analysis, and what gives its images; the clip's rig is that of the short one."""
    recording = disctrack.read_recording(sample_clip)
    images = images_of(recording, 60)
    measurement = disctrack.measure_pairs(images, disctrack.read_rig(rig_file), recording.disc, recording.frame_rate)
    return measurement.trajectory, analyse(measurement.trajectory), images


@pytest.fixture(scope="module")
def page(measured, tmp_path_factory):
    trajectory, analysis, images = measured
    file = tmp_path_factory.mktemp("page") / "motion.html"
    made = motion_html(analysis, "a <clip> & more", lambda row: draw_pair(images[row], trajectory, row))
    file.write_text(made, encoding="utf-8")
    return file


def test_the_page_holds_the_trajectory_and_nothing_from_outside(page, measured):
    trajectory, *_ = measured
    text = page.read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="motion-data">(.*?)</script>', text, re.DOTALL)[1].replace("<\\/", "</"))
    assert np.array(data["xyz"]) == pytest.approx(1e3 * trajectory.q[:, :3], abs=1e-4)
    theta = data["series"][0]
    assert np.array(theta["value"]) == pytest.approx(np.degrees(trajectory.q[:, 4]), abs=1e-6)
    assert np.array(theta["sigma"]) == pytest.approx(np.degrees(trajectory.coordinate_sigma[:, 4]), abs=1e-7)
    # the contact lies one radius down the slope of the disc, on the table, by the closed form of the paper
    psi, tilt = trajectory.q[:, 3], trajectory.q[:, 4]
    disc = trajectory.disc
    lever = disc.radius * np.cos(tilt) - disc.half_thickness * np.sin(tilt)
    expected = trajectory.q[:, :2] + lever[:, None] * np.column_stack([np.sin(psi), -np.cos(psi)])
    found = np.array(data["contact"], float)
    # the page's curve is smoothed over noise of psi
    assert 1e-3 * found[5:-5] == pytest.approx(expected[5:-5], abs=5e-5)
    assert len(data["pictures"]) == 60
    assert "a &lt;clip&gt; &amp; more" in text
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "http" not in re.sub(r"data:image[^\"]*", "", text)


def test_gaps_are_null_and_not_numbers(measured):
    _trajectory, analysis, _ = measured
    text = motion_html(analysis, "without pictures")
    assert "NaN" not in re.search(r'id="motion-data">(.*?)</script>', text, re.DOTALL)[1]
    assert "were not at hand" in text


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --virtual-time-budget=4000 --enable-logging=stderr"
)


def browse(page, profile, *flags):
    """What the browser writes when it shows frame 30 of the page without an error."""
    command = [BROWSER, *FLAGS.split(), f"--user-data-dir={profile}", *flags, f"{page.as_uri()}#frame=30"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    problems = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "Uncaught" in line]
    assert not problems, problems
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_a_browser_shows_the_frame_that_was_asked_for(page, measured, tmp_path):
    trajectory, *_ = measured
    dom = browse(page, tmp_path / "profile", "--dump-dom")
    assert f"frame 30   t = {trajectory.time[30]:.4f} s" in dom
    assert f"θ {np.degrees(trajectory.q[30, 4]):.3f}" in dom


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
@pytest.mark.parametrize(
    ("size", "flags", "background"),
    [
        ((1280, 1500), [], (249, 247, 245)),
        ((390, 2400), [], (249, 247, 245)),
        ((1280, 1500), ["--blink-settings=preferredColorScheme=0"], (31, 25, 20)),
    ],
)
def test_light_dark_and_phone_are_drawn(page, size, flags, background, tmp_path):
    picture, (width, height) = tmp_path / "page.png", size
    browse(page, tmp_path / "profile", f"--screenshot={picture}", f"--window-size={width},{height}", *flags)
    image = cv2.imread(str(picture))
    assert tuple(int(v) for v in image[3, 3]) == background
    blue, vermilion = [(178, 114, 0), (232, 185, 109)], [(0, 94, 213), (92, 154, 255)]
    for inks in (blue, vermilion):  # the curves; the cursor, in the colours of light or dark
        near = [np.abs(image.astype(int) - ink).max(axis=-1) < 12 for ink in inks]
        assert max(int(part.sum()) for part in near) > 300
    assert image[:, -1].std(axis=0).max() < 1  # nothing sticks out to the right
