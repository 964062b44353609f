"""The example in the docstring of every public name runs, and shows what stands below it."""

import doctest
import inspect
import shutil
from pathlib import Path

import numpy as np
import pytest

import disctrack
from disctrack.cli import main
from disctrack.files.labelled_arrays import Variable
from tests.rendering import SMALL_SCENE

NAMES = [name for name in disctrack.__all__ if inspect.isclass(item := getattr(disctrack, name)) or callable(item)]


@pytest.fixture(scope="module")
def measured(sample_clip, tmp_path_factory) -> Path:
    """A folder with the sample recording as clip, measured, and a small scene."""
    folder = tmp_path_factory.mktemp("examples")
    shutil.copytree(sample_clip, folder / "clip", ignore=shutil.ignore_patterns("results"))
    assert main(["run", str(folder / "clip"), "--no-figures", "--no-video"]) == 0
    (folder / "scene.toml").write_text(SMALL_SCENE.format(kind="rolling"))
    return folder


@pytest.mark.statistical
@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_runs(name, measured, monkeypatch, capsys):
    monkeypatch.chdir(measured)
    names = {public: getattr(disctrack, public) for public in disctrack.__all__}
    text = inspect.getdoc(getattr(disctrack, name)) or ""
    test = doctest.DocTestParser().get_doctest(text, names | {"np": np, "Variable": Variable}, name, None, None)
    assert test.examples, f"{name} has no example"
    failed, _ = doctest.DocTestRunner(verbose=False).run(test)
    assert not failed, capsys.readouterr().out
