"""Pages and JSON: what stands in them is what was given, whatever it is."""

import json
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from disctrack.diagnosis.pages.figures import candidates
from disctrack.files.json_text import json_file, json_text, plain
from disctrack.report import palette
from disctrack.report.figures import Drawn, draw, plain_powers
from disctrack.report.parts import Markup, as_typed, bullets, gallery, page, paragraph, section, table, typeset, warning


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


def test_a_page_is_whole_and_shows_text_as_text():
    nasty = "<script>alert('ψ & 1 < 2')</script>"
    parts = [
        paragraph(nasty, "lead"),
        warning(nasty, [nasty]),
        section(nasty, [table(nasty, ["a", nasty], [(nasty, "1"), (Markup("<b>2</b>"), "3")], ["done", "failed"])]),
    ]
    tree = Tree(page(nasty, parts))
    assert tree.open == []
    assert "script" not in tree.seen
    assert nasty in tree.cells
    assert tree.seen.count("b") == 2  # the warning's title, and what was said to be HTML


def test_nothing_to_show_leaves_no_empty_frame():
    assert not warning("mind", [])
    assert not bullets([])
    assert not section("empty", ["", paragraph("")])
    with pytest.raises(ValueError, match="zip"):
        table("", ["a"], [("1",), ("2",)], ["done"])


def test_a_figure_is_written_whole_and_shown(tmp_path):
    figure = Figure()
    figure.add_subplot().plot([0, 1], color=palette.BLUE)
    drawn = Drawn("01_line", "A line", "rises & falls", figure)
    files, pictures = draw(tmp_path, [drawn])
    assert [f.name for f in files] == ["01_line.png", "01_line.pdf"]
    assert (tmp_path / "figures/01_line.pdf").read_bytes().startswith(b"%PDF")
    files, pictures = draw(tmp_path / "page alone", [drawn], ())
    assert files == []
    assert not (tmp_path / "page alone").exists()
    shown = gallery([drawn], pictures)
    assert "data:image/svg+xml;base64," in shown
    assert "rises &amp; falls" in shown


def luminance(colour):
    channels = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return linear


def test_colours_stay_apart_for_a_reader_without_green_receptors():
    """Deuteranopia by the matrix of Vienot, Brettel and Mollon (1999); distances in linear light."""
    blind = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    seen = [blind @ luminance(c) for c in (palette.BLUE, palette.RED, palette.GREEN, palette.AMBER, palette.SKY)]
    apart = min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i])
    worst_before = np.linalg.norm(blind @ luminance("#c8553d") - blind @ luminance("#4f8a4c"))  # red, green
    assert apart > 0.1 > worst_before


def test_json_holds_no_number_that_json_does_not_know():
    document = {
        "a": [np.nan, np.float32(np.inf), (1, np.int64(2))],
        "b": {3: np.array([[1.0, np.nan]]), "t": np.bool_(True)},
        "c": "ψ",
    }
    expected = {"a": [None, None, [1, 2]], "b": {"3": [[1.0, None]], "t": True}, "c": "ψ"}
    assert json.loads(json_text(document)) == expected == plain(document)
    assert json_file(document).endswith(b"}\n")


def test_numbers_and_angles_are_set_as_people_write_them():
    assert typeset("k < 2.6e-07 m s, -5e+10, 3e5").replace("\xa0", " ") == "k < 2.6 × 10⁻⁷ m s, -5 × 10¹⁰, 3 × 10⁵"
    small = "x < 2.6e-07 m, y < 1.25e-05 rad; t < 3e-08 s (95 %)"
    assert typeset(small) == "x < 0.26 µm, y < 12.5 µrad; t < 30 ns (95 %)"
    assert typeset("c < 5e-13 m, k 2e-08 m^2").replace("\xa0", " ") == "c < 5 × 10⁻¹³ m, k 2 × 10⁻⁸ m²"
    assert typeset("M = k psidot / sin theta, phi") == "M = k ψ̇ / sin θ, φ"
    assert typeset("psi + phi. Then theta.") == "ψ + φ. Then θ."
    for kept in ("state.theta", "theta_deg", "figures/theta.png", "theta.png", "1e", "case1e5", "0.2.0+1e5", "12e45…"):
        assert typeset(kept) == kept


def test_sentences_in_cells_wrap_and_numbers_do_not():
    said = "gains 4.57, noise alone reaches 21.6; only bounded: translation_x"
    made = table("", ["a", "b"], [("1.234 ± 0.001", said), ("2", "short")])
    assert made.count("class=said") == 2  # all of its column
    assert f"<td class=said>{said}" in made


def test_a_logarithmic_axis_shows_plain_numbers():
    for span, few in (
        ((2.2, 14.0), {"3", "5", "7", "10"}),
        ((0.3, 5.0), {"0.5", "1", "2", "5"}),
        ((10.0, 900.0), {"10", "100"}),
    ):
        axes = Figure().add_subplot()
        axes.set_yscale("log")
        axes.set_ylim(*span)
        plain_powers(axes.yaxis)
        shown = {t.get_text() for t in (*axes.get_yticklabels(), *axes.get_yticklabels(minor=True))} - {""}
        assert few <= shown
        assert not any("10^" in text for text in shown)


def test_a_candidate_without_which_nothing_fits_has_the_longest_bar():
    def tried(name, score, gain):
        return SimpleNamespace(candidate=SimpleNamespace(name=name), score=score, gain=gain)

    found = SimpleNamespace(candidate=SimpleNamespace(name="frame_rate"), cannot_be_told_from=())
    diagnosis = SimpleNamespace(
        tried=(tried("frame_rate", np.inf, np.inf), tried("kz", 4.0, None), tried("tilt", 900.0, 800.0)),
        found=(found,),
        settings=SimpleNamespace(false_alarm=0.005),
    )
    drawn = candidates(SimpleNamespace(diagnosis=diagnosis, system=SimpleNamespace(candidates=range(50))))
    (axes,) = drawn.figure.axes
    lengths = [bar.get_width() for bar in axes.patches]
    assert lengths[1:] == [4.0, 800.0]
    assert np.isfinite(lengths[0])
    assert lengths[0] > 5 * max(lengths[1:])
    assert "without it nothing fits" in [text.get_text() for text in axes.texts]


def test_formulas_of_the_reader_stay_as_they_were_typed():
    assert bullets([as_typed("dtheta/dt = omega - sin(theta) < 1e-3")]) == (
        "<ul><li>dtheta/dt = omega - sin(theta) &lt; 1e-3</li></ul>"
    )
