"""Every kind of finding comes first, with the right value, in every stage that can know it."""

import json
import os
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
from scipy.ndimage import fourier_shift

from calibration.rig_file import read_rig
from disctrack.cli import main
from disctrack.diagnosis.recorded import wrong_declarations
from disctrack.findings import Finding, Kind, Severity, finding_from_json, in_doubt, leading
from disctrack.first_look.check import run_check
from disctrack.frames import CAMERAS
from disctrack.validate.planted_faults import CHANGES, declare, redrawn, reordered
from tests.pipeline.conftest import grey_values, linked

Plant = Callable[[Path, dict], object]  # into a folder, and into what is declared in it


def fault(kind: Kind, grave: str, words: str, plant: Plant, stages: str = "check run analyse diagnose"):
    """What is wrong, what is to be said of it first, and the stages that can know it."""
    return SimpleNamespace(kind=kind, grave=grave, words=words, plant=plant, stages=stages)


def says(section: str, **values) -> Plant:
    return lambda folder, tree: tree[section].update(values)


def planted(name: str, size: float) -> Plant:
    return lambda folder, tree: CHANGES[name].change(folder, tree, size)


def drawn(change, cameras=CAMERAS) -> Plant:
    """Other images; change(image, share of the recording before it)."""
    return lambda folder, tree: [reordered(folder / camera, partial(redrawn, change=change)) for camera in cameras]


def late(by: int, ahead: str, behind: str) -> Plant:
    """A camera lost its first frames, and both end together."""

    def plant(folder, tree):
        reordered(folder / ahead, lambda files: files[by:])
        reordered(folder / behind, lambda files: files[:-by])

    return plant


def stacked(**attributes) -> Plant:
    """All frames of a camera in one file that says something of them."""

    def plant(folder, tree):
        with h5py.File(folder / "frames.h5", "w") as file:
            for camera in CAMERAS:
                file.create_dataset(camera, data=grey_values(folder / camera)).attrs.update(attributes)
                tree["cameras"][camera] = f"frames.h5:/{camera}"

    return plant


def exchanged_with_the_views(folder, tree):
    for section in ("cameras", "calibration"):
        tree[section]["left"], tree[section]["right"] = tree[section]["right"], tree[section]["left"]


def moved(image, x, y):
    move = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
    return cv2.warpAffine(image, move, image.shape[::-1], flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def for_a_while(image, share):
    return moved(image, 4, 5) if 0.4 <= share < 0.47 else image


def trembling(folder, tree):
    """A table that trembles by 3 um: all that the cameras see of the disc moves alike, by hundredths of a pixel."""
    rig, middle = read_rig(folder / "rig.h5"), np.array([[0.0, 0.0, 0.005]])
    away = rig.project(middle + np.random.default_rng(1).normal(0, 3e-6, (300, 3))) - rig.project(middle)
    for camera, shifts in zip(CAMERAS, away, strict=True):

        def shaken(image, share, shifts=shifts):
            spectrum = fourier_shift(np.fft.fft2(image), shifts[round(share * 300)][::-1])
            return np.fft.ifft2(spectrum).real.round().clip(0, 255).astype(np.uint8)

        reordered(folder / camera, partial(redrawn, change=shaken))


def grey(image):
    """In place of it, nothing."""
    return np.random.default_rng(2).normal(120, 10, image.shape).clip(0, 255).astype(np.uint8)


def noisy(image, share):
    noise = np.random.default_rng(round(300 * share)).normal(0, 10, image.shape)
    return (0.8 * image + noise).clip(0, 255).astype(np.uint8)


def grained(image, share):
    """Paper whose grain the dots' edges follow."""
    grain = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 5.3, image.shape), (0, 0), 1.5)
    return (image * (1 + 0.1 * np.roll(grain, round(2000 * share), axis=0))).clip(0, 255).astype(np.uint8)


def stuck_pixels(image, share):
    image[tuple(np.random.default_rng(4).integers(0, 272, (2, 40)))] = 255
    return image


def filtered(image, share):
    return (image * np.tile([[1.0, 0.6], [0.6, 0.8]], (136, 136))).astype(np.uint8)


def numbered_from_one(folder, tree):
    for number, file in reversed([*enumerate(sorted((folder / "right").iterdir()))]):
        file.rename(file.with_name(f"{number + 1:06d}.png"))


def hidden(image, share):
    return grey(image) if share < 0.7 else image


def hidden_once(image, share):
    return grey(image) if round(300 * share) == 20 else image


DOTS = [[26.0, 0.0], [13.0, 22.5167], [-13.0, 22.5167], [-26.0, 0.0], [-13.0, -22.5167], [6.5, -11.2583]]
FAULTS = {
    # what is declared
    "a key is missing": fault(Kind.DECLARATION, "refusal", "mass_g is missing",
                              lambda _, tree: tree["disc"].pop("mass_g")),
    "wrong square": fault(Kind.SQUARE, "doubt", "square_mm: 6.00 would fit (declared 6.1)",
                          says("calibration", square_mm=6.1)),
    "squares of 10": fault(Kind.SQUARE, "doubt", "square_mm: 6.00 would fit (declared 10)",
                           says("calibration", square_mm=10.0)),
    "squares in cm": fault(Kind.SQUARE, "refusal", "square_mm: 6.00 would fit (declared 0.6)",
                           says("calibration", square_mm=0.6)),
    "small dots": fault(Kind.DIAMETER, "refusal", "diameter_mm: 7", says("markers", diameter_mm=3.0)),
    "wrong radius": fault(Kind.RADIUS, "warning", "radius_mm: 37.", says("disc", radius_mm=39.5)),
    "diameter for radius": fault(Kind.RADIUS, "doubt", "radius_mm: 37.", says("disc", radius_mm=75.0)),
    "wrong thickness": fault(Kind.THICKNESS, "doubt", "thickness_mm: 6.00 would fit (declared 6.5)",
                             says("disc", thickness_mm=6.5)),
    "foam": fault(Kind.DENSITY, "warning", "[disc] mass_g (declared 0.9)", says("disc", mass_g=0.9)),
    "twice the rate": fault(Kind.GRAVITY_OR_RATE, "doubt", "frame_rate_hz: 1000 would fit (declared 2000)",
                            says("cameras", frame_rate_hz=2000.0)),
    "gravity in cm": fault(Kind.GRAVITY_OR_RATE, "doubt", "g_m_s2: 9.8", says("gravity", g_m_s2=981.0)),
    "backwards": fault(Kind.REVERSED, "doubt", "in the order of time", planted("reversed", 1)),
    "short side first": fault(Kind.CORNERS, "doubt", "inner_corners: [9, 6] would fit",
                              says("calibration", inner_corners=[6, 9])),
    "a dot a millimetre off": fault(Kind.DOTS_MISPLACED, "doubt", "dot 0 by 1.00 mm",
                                    says("markers", centres_mm=[[25.0, 0.0], *DOTS[1:]])),
    "no dot there": fault(Kind.DOT_UNSEEN, "warning", "dot 5", says("markers", centres_mm=[*DOTS[:5], [0.5, 0.5]])),
    "dots that repeat": fault(Kind.SYMMETRIC_DOTS, "warning", "repeats every 180 deg",
                              says("markers", centres_mm=[DOTS[i] for i in (0, 1, 3, 4)])),
    # the table
    "wrong view": fault(Kind.TABLE_VIEW, "doubt", "view: 0 would fit (declared 3)", says("table", view=3)),
    "board of no thickness": fault(Kind.BOARD_THICKNESS, "doubt", "board_thickness_mm: 3.00 would fit (declared 0)",
                                   says("table", board_thickness_mm=0.0)),
    "board of another thickness": fault(Kind.TABLE_DISAGREES, "warning", "µm from the board's",
                                        says("table", board_thickness_mm=3.2)),
    # the cameras
    "cameras exchanged": fault(Kind.EXCHANGED, "doubt", "the left and right images are exchanged",
                               planted("exchanged", 1)),
    "one camera mirrored": fault(Kind.MIRRORED, "doubt", "right camera's images are mirrored", planted("mirrored", 1)),
    "named wrongly": fault(Kind.HANDEDNESS, "doubt", "stands 296 mm to the right", exchanged_with_the_views),
    "a camera turned": fault(Kind.CAMERA_MOVED, "doubt", "was turned by about 0.8 deg",
                             drawn(lambda image, _: moved(image, 9, 12), ["right"])),
    "a camera turned a little": fault(Kind.DOTS_MISFIT, "doubt", "a camera moved or was refocused",
                                      drawn(lambda image, _: moved(image, 0.4, 0.7), ["right"])),
    "a camera pushed for a while": fault(Kind.CAMERAS_CONTRADICT, "doubt", "frames 120-140 are refused",
                                         drawn(for_a_while, ["right"])),
    "a camera on its side": fault(Kind.ONE_SIDED, "doubt", "the dots of only one camera make sense",
                                  drawn(lambda image, _: np.rot90(image), ["right"])),
    "grain": fault(Kind.DOTS_SCATTER, "warning", "times more than the image noise", drawn(grained)),
    "a trembling table": fault(Kind.POSES_SCATTER, "warning", "height by", trembling),
    "exposure declared": fault(Kind.EXPOSURE, "warning", "declared (or in the cameras' headers) as 950",
                               says("cameras", exposure_us=950.0)),
    "a colour filter": fault(Kind.SENSOR, "warning", "a colour filter lies on the sensor", drawn(filtered)),
    "stuck pixels": fault(Kind.SENSOR, "warning", "40 pixels show one value", drawn(stuck_pixels, ["left"])),
    "too bright": fault(Kind.LIGHT, "warning", "clipped", drawn(lambda image, _: cv2.add(image, 90))),
    "lens cap": fault(Kind.LIGHT, "refusal", "of one grey", drawn(lambda image, _: 0 * image, ["left"]), "check"),
    "out of focus": fault(Kind.SHARPNESS, "warning", "the blur of opposite edges overlaps",
                          drawn(lambda image, _: cv2.GaussianBlur(image, (0, 0), 3.0))),
    "noise": fault(Kind.ACCURACY, "warning", "a position has a standard deviation of", drawn(noisy)),
    # the clock
    "one frame late": fault(Kind.DELAY, "doubt", "Number its images higher by 1", late(1, "left", "right")),
    "three frames late": fault(Kind.DELAY, "doubt", "Number its images higher by 3", late(3, "right", "left")),
    "images lost by one": fault(Kind.DROPPED_FRAMES, "doubt", "left out 3 images at frame 150",
                                planted("images lost by one", 3)),
    "ten images lost by one": fault(Kind.DROPPED_FRAMES, "doubt", "left out 10 images",
                                    planted("images lost by one", 10)),
    "pairs lost by both": fault(Kind.CLOCK_JUMP, "doubt", "frame 150: the clock jumps by 3",
                                planted("pairs lost by both", 3)),
    "one moment twice": fault(Kind.REPEATED_IMAGES, "doubt", "1 repeat of earlier images",
                              planted("images repeated by one", 1)),
    "stamps in ms": fault(Kind.TIME_STAMPS, "doubt", "they give 1 frames/s", stacked(timestamps=np.arange(300.0))),
    "the file of a slower camera": fault(Kind.HEADERS, "warning", "file states 500 Hz", stacked(frame_rate=500.0)),
    # the files, and the rest
    "other numbers": fault(Kind.READING, "refusal", "equal numbers must be the same instant", numbered_from_one),
    "broken files": fault(Kind.UNREADABLE, "warning", "3 images could not be read", planted("files damaged", 3)),
    "a hand": fault(Kind.FRAMES_LOST, "doubt", "have no pose", drawn(hidden)),
    "no disc": fault(Kind.DISC_NOT_FOUND, "refusal", "the disc was found", drawn(lambda image, _: grey(image))),
    "other corners": fault(Kind.CALIBRATION, "refusal", "inner_corners = [9, 6]",
                           says("calibration", inner_corners=[8, 5])),
    "views late in one": fault(Kind.CALIBRATION, "refusal", "the right ones come 1 early",
                               planted("views late in one", 1)),
    "negative views": fault(Kind.CALIBRATION, "doubt", "the paper round the board", planted("negative views", 1)),
    "a hand for a moment": fault(Kind.ANALYSIS, "warning", "1 of 300 frames have", drawn(hidden_once), "analyse"),
    "a hand in between": fault(Kind.DIAGNOSIS, "note", "1 of the 300 frames have", drawn(hidden_once), "diagnose"),
}  # fmt: skip


@pytest.fixture
def recording(sample_clip, rig_file, tmp_path):
    """Plants a fault into a copy of the sample; returns its folder."""

    def plant(fault: str) -> Path:
        folder = linked(sample_clip, tmp_path / "day" / fault)
        tree = tomllib.loads((folder / "recording.toml").read_text())
        os.link(rig_file, folder / "rig.h5")
        FAULTS[fault].plant(folder, tree)
        declare(folder, tree)
        return folder

    return plant


def test_every_kind_is_planted():
    assert {planted.kind for planted in FAULTS.values()} == set(Kind) - {Kind.OTHER}


def comes_first(name: str, findings: Sequence[Finding]) -> bool:
    planted, first = FAULTS[name], findings[0]
    return (first.kind, first.grave) == (planted.kind, planted.grave) and planted.words in first.sentence


def known_in(*stages: str) -> list[str]:
    return [name for name, planted in FAULTS.items() if set(stages) & set(planted.stages.split())]


@pytest.mark.statistical
@pytest.mark.parametrize("name", known_in("check"))
def test_check_names_the_fault_first(name, recording):
    problems = leading(run_check(recording(name)).findings)
    if FAULTS[name].kind == Kind.DOT_UNSEEN:  # before the run there is time to mend it
        assert problems[0].doubtful
        problems = [replace(problems[0], severity=Severity.WARNING)]
    assert comes_first(name, problems), problems[0]
    if "late" in name:  # and it is told once, not by every place looked at and by all that follows from it
        assert len([finding for finding in problems if finding.severity >= Severity.WARNING]) == 1


def ended(capsys, *words: str) -> tuple[int, list[Finding], str]:
    """Exit code, findings and errors of a command."""
    code = main([*words, "--json"])
    out, errors = capsys.readouterr()
    return code, [finding_from_json(finding) for finding in json.loads(out)["findings"]] if out else [], errors


@pytest.mark.statistical
@pytest.mark.parametrize("name", known_in("run", "analyse", "diagnose"))
def test_run_and_the_stages_after_it_name_the_fault_first(name, recording, capsys):
    folder, known = str(recording(name)), FAULTS[name]
    code, findings, errors = ended(capsys, "run", folder, "--no-figures", "--no-video")
    if code == 1:
        assert not findings
        assert known.words in errors
        return
    assert code == (3 if in_doubt(findings) or known.kind == Kind.UNREADABLE else 0)
    if "run" in known.stages:
        assert comes_first(name, findings), findings[0]
    if "analyse" in known.stages:
        again, findings, errors = ended(capsys, "analyse", folder)
        assert again == code, errors
        assert comes_first(name, findings), findings[0]
    if known.stages == "diagnose" or wrong_declarations(findings):
        again, findings, errors = ended(capsys, "diagnose", folder)
        assert again == code, errors
        assert comes_first(name, findings), findings[0]


@pytest.mark.statistical
@pytest.mark.parametrize(
    "names",
    [
        ["a key is missing", "wrong square", "cameras exchanged", "no disc", "stuck pixels", "broken files"],
        pytest.param(known_in("run"), marks=pytest.mark.slow),
    ],
)
def test_a_batch_names_every_fault_first(names, recording, capsys):
    *_, day = (recording(name).parent for name in names)
    assert main(["batch", str(day), "--no-report"]) == 1
    summary = json.loads((day / "batch_results" / "summary.json").read_text())
    rows = {row["recording"]: row for row in summary["recordings"]}
    for name in names:
        row, known = rows[name], FAULTS[name]
        assert (row["finding"], row["severity"]) == (known.kind.value, known.grave), row
        if known.grave != "warning":
            assert known.words in row["reason"]
