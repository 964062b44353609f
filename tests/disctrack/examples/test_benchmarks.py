"""Public benchmarks from the files of their authors: withheld friction is found, and the test part is predicted."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from disctrack.examples._command import command
from disctrack.examples.benchmarks import example


def positions(rng, path, frequencies):
    """As the positioning system's file has them: a carriage of 95 kg with dry friction of 20 N, at 1 kHz."""
    t = 0.001 * np.arange(6000)
    volts = sum(2.5 * np.sin(2 * np.pi * f * t + f) for f in frequencies)
    q, x, v = np.zeros(6000), 0.0, 0.0
    for i in range(5999):
        for _ in range(4):
            v += 0.00025 * (35.0 * volts[i] - 200 * v - 20 * np.tanh(v / 1e-4)) / 95
            x += 0.00025 * v
        q[i + 1] = x
    seen = q + 1e-6 * rng.standard_normal(6000)
    savemat(path, {"t": t[:, None], "qm": seen[:, None], "vir": volts[:, None], "gtau": 35.0})


@pytest.mark.statistical
def test_friction_of_the_positioning_system_is_found_and_its_test_part_is_predicted(rng, tmp_path, capsys):
    positions(rng, tmp_path / "DATA_EMPS.mat", (0.3, 0.7))
    positions(rng, tmp_path / "data_emps_pulses.mat", (0.4, 1.1))
    command(example, "files", [str(tmp_path), "-o", str(tmp_path / "out")])
    assert "EMPS" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["EMPS"]
    assert [e["name"] for e in found["effects"]] == ["coulomb_v"]
    assert found["test"]["error"] < 0.1  # mm, of a path of some 100
    with pytest.raises(SystemExit):
        command(example, "files", [str(tmp_path / "out")])
    assert "no benchmark found" in capsys.readouterr().err
