"""The file for the 3-D viewer, read back by the viewer's own tools."""

import re
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.analyse.analysis import analyse
from disctrack.analyse.viewer import _cylinder, _normals, write_rerun
from disctrack.disc import MA_2014
from disctrack.errors import OutputError
from tests.oracles.measured_disc import measured


@pytest.fixture(scope="module")
def analysis():
    trajectory = measured(n=60)
    return analyse(trajectory)


def test_disc_is_a_closed_body_with_its_outside_to_the_front():
    vertices, triangles = _cylinder(MA_2014)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6  # divergence theorem; negative if the faces looked inwards
    n = 96
    polygon = n / (2 * np.pi) * np.sin(2 * np.pi / n)  # area of the 96-gon over that of its circle
    assert_allclose(volume, polygon * np.pi * MA_2014.radius**2 * 2 * MA_2014.half_thickness, rtol=1e-12)
    assert (np.sum(_normals(vertices, triangles) * vertices, axis=1) > 0).all()


def test_without_the_package_the_message_tells_what_to_install(analysis, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match="pip install rerun-sdk"):
        write_rerun(tmp_path / "motion.rrd", analysis)
    assert not list(tmp_path.iterdir())


def test_viewer_finds_every_pose_and_curve(analysis, tmp_path):
    pytest.importorskip("rerun", reason="the 3-D viewer is an optional package")
    path = tmp_path / "motion.rrd"
    write_rerun(path, analysis)
    printed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(path)], capture_output=True, text=True, check=True
    ).stdout
    rows = {entity: int(n) for n, entity in re.findall(r"with (\d+) rows .* - (/\S+) - data", printed)}
    poses = int(analysis.motion.known.sum())
    for entity in ("/world/disc", "/curves/theta_deg", "/curves/total", "/curves/psidot"):
        assert rows[entity] == poses
    assert {"/world/left", "/world/right", "/world/table", "/world/disc/body", "/world/disc/dots"} <= set(rows)
