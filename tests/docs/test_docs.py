"""What README and documentation say is run: commands, snippets, tables of keys and effects, links and pictures.

A block ```sh or ```python runs in the default tests, those below <!-- slow --> with `-m slow`, page by page in
one folder with the sample data in it. Commands that do not begin with disctrack are the shell's own (mkdir, cp, cat).
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import disctrack.cli
from disctrack.cli import COMMANDS
from disctrack.faults.catalogue import FAULTS
from disctrack.recording.declaration import KEYS, TARGET_KEYS, read_recording
from disctrack.rolling import CATALOGUE
from disctrack.trajectory.exchange.formats import ROWS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "disctrack" / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
BLOCK = re.compile(r"^(?:(<!-- slow -->)\n)?```(sh|python|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
IN_TEXT = re.compile(r"`(disctrack [^`]+)`")
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def text_of(page: Path) -> str:
    if not page.is_file():
        pytest.skip("not in this checkout")
    return page.read_text(encoding="utf-8")


def blocks_of(text: str) -> list[tuple[str, str, str]]:
    """(language, whether it is slow, content) of every block of a page."""
    return [(kind, slow, block) for slow, kind, block in BLOCK.findall(text)]


def commands_of(shell: str) -> list[list[str]]:
    """disctrack's own commands of a block, without what lies in here-documents."""
    shell = re.sub(r"<<'(\w+)'\n.*?^\1$", "", shell, flags=re.MULTILINE | re.DOTALL)
    return [shlex.split(line, comments=True) for line in shell.splitlines() if line.startswith("disctrack ")]


def with_sample(folder: Path) -> Path:
    """The folder with a copy of the sample data in it."""
    clip, ignored = Path("sample_data", "clip"), shutil.ignore_patterns("results")
    shutil.copytree(ROOT / clip, folder / clip, ignore=ignored)
    return folder


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """Where short blocks of pages are run."""
    return with_sample(tmp_path_factory.mktemp("reader"))


def run_shell(block: str, folder: Path) -> None:
    """A block as bash runs it, disctrack from this interpreter; a command that fails ends it."""
    bin_folder = folder / ".bin"
    bin_folder.mkdir(exist_ok=True)
    program = bin_folder / "disctrack"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m disctrack "$@"\n')
    program.chmod(0o755)
    lines = "\n".join(line for line in block.splitlines() if not line.startswith(("pip ", "pytest ")))
    environment = os.environ | {"PATH": f"{bin_folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-euc", lines], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{lines}\n{done.stdout}\n{done.stderr}"


@pytest.mark.statistical
@each_page
def test_short_blocks_run(page, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    scope: dict[str, object] = {}
    for kind, slow, block in blocks_of(text_of(page)):
        if slow or page.name == "README.md":
            continue
        if kind == "sh":
            run_shell(block, workplace)
        elif kind == "python":
            exec(compile(block, page.name, "exec"), scope)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """A workplace of its own after the README was followed: nothing there was made by single blocks before."""
    workplace = with_sample(tmp_path_factory.mktemp("follower"))
    for kind, _, block in blocks_of(text_of(ROOT / "README.md")):
        if kind == "sh":
            run_shell(block, workplace)
    return workplace


@pytest.mark.slow
@each_page
def test_all_blocks_run_in_their_order(page, measured, monkeypatch):
    monkeypatch.chdir(measured)
    scope: dict[str, object] = {}
    for kind, _, block in blocks_of(text_of(page)):
        if kind == "sh" and page.name != "README.md" and not ("mkdir -p sheets" in block or "-o sheets" in block):
            run_shell(block.replace("rm my-disc", "rm -f my-disc"), measured)
        elif kind == "python":
            exec(compile(block, page.name, "exec"), scope)
    if page.name == "tour.md":
        text = (measured / "tour/secret/results/trajectory_diagnosis/diagnosis.json").read_text()
        assert '"found"' in text
        assert "centre_of_mass" in text


@each_page
def test_every_command_exists_with_its_options(page, monkeypatch):
    text = text_of(page)
    written = [command for kind, _, block in blocks_of(text) if kind == "sh" for command in commands_of(block)]
    written += [shlex.split(command) for command in IN_TEXT.findall(text)]
    for command in written:
        if command[1] == "COMMAND":
            continue
        assert command[1] in COMMANDS, command
        parser = disctrack.cli._parser()[0]
        sub = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices[command[1]]
        known = {option for action in sub._actions for option in action.option_strings}
        for word in command[2:]:
            if word.startswith("-") and not re.fullmatch(r"-?[0-9.]+", word):
                assert word.partition("=")[0] in known, f"{' '.join(command)}: no option {word}"


@each_page
def test_every_block_is_one_for_every_renderer_of_markdown(page):
    """One word after the fence: with two, Python's Markdown, of which the site is built, takes it for a paragraph."""
    fences = re.findall(r"^```.*$", text_of(page), re.MULTILINE)
    assert all(re.fullmatch(r"```[a-z]*", fence) for fence in fences)
    assert len(fences) % 2 == 0
    assert sum(len(fence) > 3 for fence in fences) == len(blocks_of(text_of(page)))  # all are run, or read


@each_page
def test_links_and_pictures_are_there(page):
    for target in LINK.findall(BLOCK.sub("", text_of(page))):
        if target.startswith(("http:", "https:")):
            continue
        file, _, anchor = target.partition("#")
        place = (page.parent / file) if file else page
        assert place.is_file(), f"{page.name}: {target}"
        if anchor:
            heads = re.findall(r"^#+ (.*)$", place.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor in slugs, f"{page.name}: {target}; {slugs}"


def test_the_readme_is_short():
    lines = BLOCK.sub("", text_of(ROOT / "README.md")).splitlines()
    prose = " ".join(line for line in lines if not line.startswith("|"))
    assert len(prose.split()) < 850


def test_every_folder_of_the_packages_stands_in_the_map():
    page = text_of(DOCS / "contributing.md")
    tree = set(re.findall(r"([a-z_]+)/", page.partition("## The map")[2].partition("Who imports whom")[0]))
    for package in ("calibration", "disctrack"):
        folders = {file.parent.name for file in (ROOT / package).rglob("__init__.py")}
        assert folders <= tree, folders - tree


def test_every_format_is_on_its_page_with_its_endings():
    rows = [line.split("|") for line in text_of(DOCS / "exchange.md").splitlines() if line.startswith("| ")]
    page = {row[1].strip(): tuple(re.findall(r"`([^`]+)`", row[2])) for row in rows[1:]}
    assert page == {row.name: row.endings for row in ROWS}


def test_every_place_for_something_new_is_there():
    page = text_of(DOCS / "contributing.md").partition("## Where something new goes")[2].partition("## Habits")[0]
    places = re.findall(r"`((?:disctrack|calibration)/[a-z_/]+(?:\.py)?)`", page)
    assert len(places) > 8
    assert all((ROOT / place).exists() for place in places), places


def test_every_key_of_a_recording_is_explained_and_the_example_is_one(tmp_path):
    text = text_of(DOCS / "recording-toml.md")
    for section, keys in KEYS.items():
        for key in keys:
            assert re.search(rf"`(\[{section}\] )?[^|]*\b{key}\b", text), f"[{section}] {key}"
    example = next(block for kind, _, block in blocks_of(text) if kind == "toml")
    (tmp_path / "recording.toml").write_text(example)
    assert read_recording(tmp_path).disc.radius == pytest.approx(0.0375)
    declared = tomllib.loads(re.sub(r"(?m)^# (?=\w+ = )", "", example))  # with what few recordings need
    elsewhere = {"rig"} | {key for keys in TARGET_KEYS.values() for key in keys} - {*TARGET_KEYS["chessboard"]}
    for section, keys in KEYS.items():
        for key in keys:
            # a rig stands in place of the views, a density of the pressure, and other targets have their own example
            if (section, key) != ("air", "density_kg_m3") and not (section == "calibration" and key in elsewhere):
                assert key in (declared[section] if section else declared), f"[{section}] {key}"


def test_every_effect_is_named():
    text = text_of(DOCS / "scenes.md")
    for name in CATALOGUE:
        assert f"`{name}`" in text, name


def test_the_faults_stand_as_the_catalogue_has_them():
    rows = ["| fault | what you see | what to do |", "|---|---|---|"]
    same: dict[tuple[str, str], list[str]] = {}
    for fault in FAULTS:
        if fault.in_images:  # sought in the dots of other programs
            continue
        what = f"`{fault.declared}`: {fault.remedy}" if fault.declared else fault.remedy or "nothing"
        title = " ".join(fault.title.format("").split())
        same.setdefault((fault.seen, what), []).append(f"`{fault.name}`: {title}")
    rows += [f"| {'; '.join(which)} | {seen} | {what} |" for (seen, what), which in same.items()]
    table = "\n".join(rows)
    assert table in text_of(DOCS / "faults.md"), table


def test_every_command_is_in_the_documentation():
    everything = "".join(page.read_text(encoding="utf-8") for page in PAGES if page.is_file())
    for command in COMMANDS:
        assert f"disctrack {command}" in everything or f"`{command}`" in everything, command


def test_every_public_name_is_in_the_reference():
    shown = set(re.findall(r"^::: (?:\w+\.)*(\w+)$", text_of(DOCS / "reference.md"), re.MULTILINE))
    assert shown == set(disctrack.__all__)


@pytest.mark.statistical
def test_a_wrong_option_or_block_would_be_noticed(workplace):
    block = "disctrack run x --no-such\n# disctrack nothing\ncat <<'END'\ndisctrack hidden\nEND\n"
    assert commands_of(block) == [["disctrack", "run", "x", "--no-such"]]
    with pytest.raises(AssertionError):
        run_shell("disctrack simulate no-such-scene.toml", workplace)


@pytest.mark.statistical
def test_an_editor_knows_the_types_of_the_recipes(tmp_path):
    """All of the page as one script, checked as strictly as mypy can, from outside the project."""
    pytest.importorskip("mypy")
    page = text_of(DOCS / "python.md")
    script = "\n".join(block for kind, _, block in blocks_of(page) if kind == "python")
    (tmp_path / "recipes.py").write_text(script + "\nreveal_type(answer)\nreveal_type(dataset)\n")
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "recipes.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "DiscDiagnosis" in done.stdout
    assert "Dataset" in done.stdout
