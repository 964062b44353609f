"""Pages and JSON: what stands in them is what was given, whatever it is."""

import io
import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from disctrack.files.json_text import json_file, json_text, plain
from disctrack.findings import Kind, Severity, of_kind
from disctrack.numbers import Measured, measured, probability, rounded, score
from disctrack.report import palette
from disctrack.report.blocks import Drawn, Facts, Figures, Listing, Markup, Report, Section, document, restored
from disctrack.report.html import link_pages, page, write_page
from disctrack.report.terminal import full, short, show


class Tree(HTMLParser):
    """Tags that were opened and not closed, the text of cells, and every tag seen."""

    VOID = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.cells = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


NASTY = "<script>alert('ψ & 1 < 2')</script>"
CHANGED = Measured(6.004e-5, 2.1e-7, "m")


def report(**more):
    numbers = [Listing(("a", "b"), [("x", CHANGED)], "A table"), Facts([("length", CHANGED), ("", "twice")])]
    blocks = ["All of it.", Section("Numbers", numbers), Section("Nothing", [Listing(("a",), ()), []])]
    return Report(**{"title": "t", "verdict": "Something is missing.", "accuracy": "σ 1 µm", "blocks": blocks} | more)


def test_a_page_is_whole_and_shows_text_as_text():
    table = Listing(["a", NASTY], [(NASTY, "1"), (Markup("<b>2</b>"), "3")], NASTY, classes=["done", "failed"])
    doubts = of_kind(Kind.OTHER, Severity.DOUBT, [NASTY])
    found = report(title=NASTY, verdict=NASTY, findings=doubts, blocks=[Section(NASTY, [table])])
    tree = Tree(page(found))
    assert tree.open == []
    assert "script" not in tree.seen
    assert NASTY in tree.cells
    assert tree.seen.count("b") == 2  # the finding's severity, and what was said to be HTML


def test_nothing_to_show_leaves_no_empty_frame():
    made = page(report())
    assert "Nothing" not in made
    assert "class=findings" not in made
    assert made.count("<section>") == 1
    assert "Nothing" not in "".join(full(report()))
    with pytest.raises(ValueError, match="zip"):
        page(report(blocks=[Listing(["a"], [("1",), ("2",)], classes=["done"])]))


def test_every_writer_shows_the_same_number():
    kept = json.loads(json_text(document(report())))
    assert kept["blocks"][1]["blocks"][0]["rows"] == [["x", {"value": 6.004e-5, "sigma": 2.1e-7, "unit": "m"}]]
    assert kept["blocks"][1]["blocks"][1]["facts"]["length"][1] == "twice"  # what goes on without a name is not lost
    assert "60.04 ± 0.21 µm" in page(report())
    assert any(line.split() == ["x", "60.04", "±", "0.21", "µm"] for line in full(report()))


def test_a_terminal_gets_ten_lines_the_gravest_first_and_is_told_of_the_rest():
    said = of_kind(Kind.OTHER, Severity.NOTE, [f"note {i} {'word ' * 30}" for i in range(9)])
    said += of_kind(Kind.OTHER, Severity.DOUBT, ["doubtful"])
    found = report(verdict="long " * 200, findings=said, files=[Path("a page.html")], then="disctrack next")
    lines = short(found, 80)
    assert 8 <= len(lines) <= 10
    assert lines[0].split() == ["doubt", "doubtful"]  # before the result
    assert lines[4].endswith("long …")  # of a long verdict, between two words
    assert max(map(len, lines)) <= 80
    assert any("more: -v shows them" in line for line in lines)
    assert lines[-2].split(maxsplit=1) == ["page", "a page.html"]
    everything = " ".join(" ".join(full(found, 80)).split())
    assert all(f"note {i} word" in everything for i in range(9))
    again = restored(json.loads(json_text(document(found))), {})
    assert short(again, 80) == lines


def test_colour_is_for_terminals_without_no_color(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("TERM", "xterm")
    shown = {}
    for no_color, stream in (("", Terminal()), ("1", Terminal()), ("", io.StringIO())):
        monkeypatch.setenv("NO_COLOR", no_color)
        monkeypatch.setattr("sys.stdout", stream)
        show(report(findings=of_kind(Kind.OTHER, Severity.DOUBT, ["wrong"])))
        shown[no_color, stream.isatty()] = "\x1b[31" in stream.getvalue()
    assert shown == {("", True): True, ("1", True): False, ("", False): False}


def test_pages_of_one_recording_name_those_that_are_there(tmp_path):
    places = {"analysis": tmp_path / "a b" / "report.html", "motion": tmp_path / "a b" / "motion.html",
              "diagnosis": tmp_path / "d" / "diagnosis.html", "video": tmp_path / "overlay.mp4"}  # fmt: skip
    for name in ("analysis", "diagnosis"):
        write_page(places[name], report())
    for _ in range(2):  # again: the same
        link_pages(places)
        assert 'href="../d/diagnosis.html"' in places["analysis"].read_text()
        assert places["diagnosis"].read_text().count('href="../a%20b/report.html"') == 1
        assert "motion" not in places["diagnosis"].read_text()


@pytest.mark.parametrize(
    ("number", "shown"),
    [
        ((6.004e-5, 2.1e-7, "m"), "60.04 ± 0.21 µm"),
        ((3.812e-3, 1.25e-5, "J"), "3.812 ± 0.013 mJ"),  # value and sigma alike
        ((0.675, 0.00996), "0.675 ± 0.010"),  # 9.96 has three digits once rounded
        ((-1e-9, 2e-7, "m"), "0 ± 200 nm"),  # no -0
        ((86227.6, 221.0), "86230 ± 220"),
        ((1.0, 99.6), "0 ± 100"),
        ((4.193e-8, 1.2e-12, "m s^2"), "(4.19300 ± 0.00012) × 10⁻⁸ m s²"),
        ((1.5, 0.0, "rad s-1"), "1.5 rad/s"),
        ((2.6e-7, float("nan"), "m s^2"), "2.6 × 10⁻⁷ m s²"),
        ((float("nan"), 1.0), "unknown"),
    ],
)
def test_value_and_sigma_have_two_digits_of_sigma(number, shown):
    assert measured(*number) == str(Measured(*number)) == shown


def test_rounding_loses_less_than_a_twentieth_of_sigma(rng):
    numbers = rng.normal(size=200) * 10 ** rng.uniform(-3, 3, 200), 10 ** rng.uniform(-4, 2, 200)
    for value, sigma in zip(*numbers, strict=True):
        shown = [float(text) for text in measured(value, sigma).split(" ± ")]
        assert shown == pytest.approx([value, sigma], abs=0.0501 * sigma)


def test_statistics_are_set_as_people_write_them():
    assert [score(x) for x in (1.239e-8, 9.04, 12345.6, np.inf, None)] == ["0.0", "9.0", "12350", "∞", ""]
    assert [probability(p) for p in (0.0, 0.571, 3e-9)] == ["< 10⁻³⁰⁰", "= 0.57", "= 3 × 10⁻⁹"]
    assert [rounded(x) for x in (-0.0, 1.5e-9, 0.04567)] == ["0", "1.5 × 10⁻⁹", "0.0457"]


def test_a_figure_is_written_whole_and_shown(tmp_path):
    figure = Figure()
    figure.add_subplot().plot([0, 1], color=palette.BLUE)
    with_figure = report(blocks=[Figures([Drawn("01_line", "A line", "rises & falls", figure)])])
    files = write_page(tmp_path / "page.html", with_figure, ("png", "pdf"))
    assert [f.name for f in files] == ["01_line.png", "01_line.pdf"]
    assert (tmp_path / "figures/01_line.pdf").read_bytes().startswith(b"%PDF")
    alone = tmp_path / "page alone" / "page.html"
    assert write_page(alone, with_figure) == []
    assert [*alone.parent.iterdir()] == [alone]
    shown = alone.read_text()
    assert "data:image/svg+xml;base64," in shown
    assert "rises &amp; falls" in shown


def test_json_holds_no_number_that_json_does_not_know():
    numbers = [np.nan, np.float32(np.inf), (1, np.int64(2))]
    document = {"a": numbers, "b": {3: np.array([[1.0, np.nan]]), "t": np.bool_(True)}, "c": "ψ"}
    expected = {"a": [None, None, [1, 2]], "b": {"3": [[1.0, None]], "t": True}, "c": "ψ"}
    assert json.loads(json_text(document)) == expected == plain(document)
    assert json_file(document).endswith(b"}\n")


def test_sentences_in_cells_wrap_and_long_tables_fold():
    said = "gains 4.57, noise alone reaches 21.6; only bounded: translation_x"
    made = page(report(blocks=[Listing(["a", "b"], [("1.234 ± 0.001", said), ("2", "short")], folded="All")]))
    assert made.count("<td class=said>") == 2  # all of its column
    assert f"<td class=said>{said}" in made
    assert "<details><summary>All</summary>" in made
