"""The notebooks of the documentation say what they said when they were stored."""

import re

import pytest

nbformat = pytest.importorskip("nbformat", reason="in the extra docs")
pytest.importorskip("nbclient", reason="in the extra docs")

from tests.docs.notebooks import FOLDER, ROOT, differences, executed, texts  # noqa: E402

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_all_notebooks_are_stored_with_outputs_and_in_the_menu():
    menu = (ROOT / "disctrack" / "mkdocs.yml").read_text(encoding="utf-8")
    assert set(re.findall(r"notebooks/(\S+)\.ipynb$", menu, re.MULTILINE)) == {notebook.stem for notebook in NOTEBOOKS}
    assert len(NOTEBOOKS) == 5
    for notebook in NOTEBOOKS:
        shown = texts(nbformat.read(notebook, as_version=4))
        assert any("a figure" in cell for cell in shown), notebook
        assert notebook.stat().st_size < 200_000, notebook


@pytest.mark.statistical
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_shows_today_what_is_stored(notebook):
    stored, now = (texts(content) for content in (nbformat.read(notebook, as_version=4), executed(notebook)))
    assert [len(cell) for cell in stored] == [len(cell) for cell in now]
    wrong = [differences(a, b) for old, new in zip(stored, now, strict=True) for a, b in zip(old, new, strict=True)]
    assert not any(wrong), wrong


def test_a_changed_word_or_number_is_noticed():
    said = "k_z = 30.0(2) um, found"
    assert not differences(said, "k_z = 30.1(2) um, found")
    assert differences(said, "k_z = 33.0(2) um, found") == ["30.0 became 33.0"]
    assert differences(said, "k_z = 30.0(2) um, unexplained")
    assert not differences("1.20e-05", "1.21e-05")
    assert differences("1.20e-05", "1.30e-05")
