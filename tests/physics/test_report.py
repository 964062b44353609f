"""The report: one file, complete, and readable in a real browser."""

import re

import cv2
import numpy as np
import pytest

from disctrack.analyse.stage import run_analyse
from disctrack.numbers import measured
from disctrack.report.palette import BLUE
from disctrack.trajectory.file import Provenance, write_trajectory
from tests.oracles.browser import BROWSER, screenshot

BLUE_BGR = np.array([int(BLUE[i : i + 2], 16) for i in (5, 3, 1)])  # of the curves


@pytest.fixture(scope="module")
def reported(tmp_path_factory, true_motion, as_tracked):
    """Report of a disc that rolls down to 0.5 degrees, with a gap."""
    folder = tmp_path_factory.mktemp("report")
    trajectory = as_tracked(
        true_motion(theta_deg=9, duration=3.0)[-1200:], np.random.default_rng(3), missing=range(100, 106)
    )
    path = folder / "rolling down.h5"
    write_trajectory(path, trajectory, Provenance("rolling <down>", {"left": "0" * 64}, {}))
    return run_analyse(path, folder / "out", figures=True)


@pytest.mark.statistical
def test_report_says_what_was_found(reported):
    page = reported.report.read_text()
    laws = reported.analysis.laws
    half = (laws.n_theta.high - laws.n_theta.low) / 2
    assert "exponent of θ (95 %)" in page
    assert measured(laws.n_theta.value, half) in page  # 4.3 sigmas, Student's t: what a reader takes for it
    assert measured(laws.n_theta.value, laws.n_theta.sigma) in page
    assert "rolls without slip from the first frame" in page
    assert "6 of 1200 frames have no pose" in page
    assert "rolling &lt;down&gt;" in page  # names are not taken for markup
    assert "0.6680" in page  # the recomputed average of the published table
    assert "0.6872" in page  # and the printed one
    references = re.findall(r'(?:src|href)="([^"]{0,40})', page)
    assert references
    assert all(text.startswith("data:image/") for text in references)  # the links of pages are another matter
    assert not re.search(r"\bnan\b", re.sub(r"base64,[^\"]*", "", page))


@pytest.mark.statistical
def test_every_figure_is_there_as_png_and_pdf(reported):
    names = {path.stem for path in reported.figures}
    for number in ("04", "05", "06", "07", "08", "09", "10", "11", "12", "13", "14", "15", "16"):
        assert any(name.startswith(number) for name in names), number
    for path in reported.figures:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG" if path.suffix == ".png" else b"%PDF"), path
        if path.suffix == ".png":
            picture = cv2.imread(str(path))
            assert picture.std() > 5, path  # not blank


def share_of_blue(picture: np.ndarray) -> float:
    return float(np.mean(np.abs(picture.astype(int) - BLUE_BGR).max(axis=2) < 12))


@pytest.mark.statistical
@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_report_shows_its_figures_in_a_browser(reported, tmp_path):
    picture = screenshot(reported.report, tmp_path, (1280, 6000))
    assert picture.shape == (6000, 1280, 3)
    assert share_of_blue(picture) > 5e-4  # curves of 1 px, 500 px long, in some 15 figures
    # negative control: the same page with its pictures damaged has no curves
    damaged = tmp_path / "damaged.html"
    damaged.write_text(reported.report.read_text().replace(";base64,", ";base64,AAAA"))
    assert share_of_blue(screenshot(damaged, tmp_path, (1280, 6000))) < 0.2 * share_of_blue(picture)
