"""disctrack simulate: from a scene to a file that explains itself, and messages where it cannot be."""

import tomllib

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.errors import ModelError, OutputError, SceneError
from disctrack.files.toml_tree import toml_value
from disctrack.rolling import CATALOGUE, Regime, effects_from_tables
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import motion_of
from disctrack.synthetic.simulation import run_simulate

WITHOUT_EFFECTS = """
name = "roll"
[cameras]
n_frames = 51
frame_rate_hz = 500.0
[motion]
kind = "rolling"
[motion.rolling]
theta_deg = 8
"""
SCENE = f"""{WITHOUT_EFFECTS}
[motion.rolling.effects.km]
[motion.rolling.effects.kz]
k_z = 6e-5
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def simulated(scene, tmp_path):
    """What a scene of this text gives, in a file of its own."""

    def run(text=SCENE, **options):
        scene.write_text(text)
        return run_simulate(scene, tmp_path / f"motion_{len(list(tmp_path.iterdir()))}.h5", **options)

    return run


def test_motion_file_holds_the_motion_with_units(simulated, tmp_path):
    run = simulated()
    assert "kz.k_z = 6e-05 m" in run.summary
    with h5py.File(run.path) as file:
        assert file.attrs["complete"] == 1
        assert file.attrs["end_reason"] == "the requested time was reached"
        assert_allclose(file["time"][()], np.arange(51) / 500)
        for i, name in enumerate(("x", "y", "z", "psi", "theta", "phi")):
            assert_allclose(file[name][()], run.motion.q[:, i])
        assert_allclose(file["energy/total"][()], run.motion.energy)
        assert_allclose(file["contact/F_z"][()], run.motion.contact_force[:, 2])
        assert file["effects"].attrs["kz.k_z"] == 6e-5

        def has_units(name, item):
            if isinstance(item, h5py.Dataset):
                assert item.attrs["units"], name
                assert item.attrs["long_name"], name

        file.visititems(has_units)
    assert list(tmp_path.glob("*.part")) == []


def test_a_motion_that_ends_gives_a_shorter_file_with_the_reason(simulated):
    with h5py.File(simulated(SCENE.replace("theta_deg = 8", "theta_deg = 0.8"), duration=1.0).path) as file:
        assert len(file["time"]) < 501
        assert file.attrs["end"] == "NUTATION"


STRUCK = SCENE.replace("theta_deg = 8", "struck = { lateral_mm = 20, vertical_mm = 10.5, impulse_N_s = 0.05 }")


def test_a_struck_disc_is_a_scene_too(simulated):
    text = STRUCK.replace("0.05 }", "0.05, friction = 0.1 }") + "[motion.rolling.effects.slip]\nmu = 0.1\n"
    assert simulated(text).motion.q[0, 4] == np.pi / 2
    with pytest.raises(SceneError, match="expected impulse_N_s, lateral_mm, vertical_mm"):
        simulated(text.replace("impulse_N_s", "impulse"))


def test_a_disc_that_never_touches_the_table_is_summed_up_too(simulated):
    state = "state = { z = 1.0, v_x = 0.0, v_y = 0.0, v_z = 0.0 }"
    run = simulated(SCENE.replace("theta_deg = 8", state), duration=0.02)
    assert (run.motion.regime == Regime.FLYING).all()
    assert "never held by the table" in run.summary
    assert "nan" not in run.summary


def test_a_scene_whose_motion_ends_where_it_starts_is_not_filmed(scene, tmp_path):
    scene.write_text(STRUCK)  # without the effect slip
    with pytest.raises(SceneError, match="over before anything is filmed: after losing contact"):
        motion_of(load_scene(scene))
    np.savetxt(tmp_path / "table.csv", [[0, 0, 0, 0, 0, 0.5, 0], [1, 0, 0, np.nan, 0, 0.5, 0]], delimiter=",")
    scene.write_text('[motion]\nkind = "table"\ntable = "table.csv"\n')
    with pytest.raises(SceneError, match="row 1 holds no finite number"):
        motion_of(load_scene(scene))


def test_what_cannot_be_simulated_is_refused_with_the_reason(simulated, scene, tmp_path):
    (tmp_path / "there.h5").write_text("")
    with pytest.raises(OutputError, match="exists"):
        run_simulate(scene, tmp_path / "there.h5")
    with pytest.raises(ModelError, match=r"2e\+09 s at 500 Hz are 1e\+12 instants; expected at most 1e\+07"):
        simulated(duration=2e9)
    with pytest.raises(SceneError, match='needs kind = "rolling"'):
        simulated('[motion]\nkind = "static"\n')


def test_an_effect_by_formula_is_simulated_and_saved(simulated):
    law = '[motion.rolling.formulas.brake]\nload_z = "-c * omega_z"\n[motion.rolling.effects.brake]\nc = 1e-4\n'
    # without it, with it, and with another law of that name in the same process
    texts = SCENE, SCENE + law, SCENE + law.replace("omega_z", "thetadot")
    without, with_it, another = (simulated(text).motion for text in texts)
    assert np.abs(with_it.q - without.q).max() > 1e-6
    assert np.abs(another.q - with_it.q).max() > 1e-6
    (brake,) = (effect for effect in with_it.model.effects if effect.name == "brake")
    assert effects_from_tables({"brake": brake.values}, {"brake": brake.formulas}) == (brake,)
    with pytest.raises(ModelError, match="brake"):
        simulated(SCENE + law.partition("[motion.rolling.effects")[0])


def test_a_number_that_a_scene_does_not_give_is_zero_and_what_it_leaves_out_is_said(simulated):
    run = simulated(WITHOUT_EFFECTS + "[motion.rolling.effects.table_tilt]\ntilt_x = 0.0035\n")
    assert run.motion.model.values == {"table_tilt.tilt_x": 0.0035, "table_tilt.tilt_y": 0.0}
    assert "without km, kn, kz, which only a scene that names no effect has" in run.summary
    assert effects_from_tables({"km": {}}) == (CATALOGUE["km"](),)
    with pytest.raises(ModelError, match="rolling_power' has a shape but no amount: give k"):
        effects_from_tables({"rolling_power": {"p": 1.5}})


def test_a_scene_without_effects_has_those_of_the_paper_at_their_nominal_sizes(simulated):
    run = simulated(WITHOUT_EFFECTS)
    assert run.motion.model.effects == tuple(CATALOGUE[name]() for name in ("km", "kn", "kz"))
    assert "; without" not in run.summary


def test_effects_survive_their_toml():
    effects = tuple(effect() for effect in CATALOGUE.values())
    text = toml_value({effect.name: effect.values for effect in effects})
    assert effects_from_tables(tomllib.loads(f"effects = {text}")["effects"]) == effects


def test_command_writes_the_motion_and_tells_how_it_went(scene, cli):
    said = cli("simulate", scene, "--duration", "0.05", "--rate", "1000").out
    assert "scene_motion.h5" in said
    assert "nutation 8" in said
    with h5py.File(scene.with_name("scene_motion.h5")) as file:
        assert len(file["time"]) == 51
