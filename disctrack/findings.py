"""What the program noticed about a measurement, as data.

A stage makes a `Finding` where it sees something, with its sentence from the room's own module of messages; later
stages read kinds, severities and numbers, never text. `leading` leaves out what another finding explains.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum, IntEnum
from typing import Any

from disctrack.numbers import Measured


class Severity(IntEnum):
    """How grave it is; a stage that tells a doubt ends with exit code 3, a refusal with 1."""

    NOTE = 0  # good to know
    WARNING = 1  # makes the result worse than it could be, within the stated sigmas
    DOUBT = 2  # the result may be wrong by more than the stated sigmas
    REFUSAL = 3  # there is no result


class Kind(Enum):
    """What was noticed; the value stands in files."""

    # what is declared
    SQUARE = "square"  # the chessboard's squares and the lengths of disc and dots are on different scales
    DIAMETER = "diameter of the dots"
    RADIUS = "radius"
    THICKNESS = "thickness"
    DENSITY = "density"
    GRAVITY_OR_RATE = "gravity or frame rate"
    REVERSED = "reversed order"  # the energy grows
    CORNERS = "inner corners"
    DOTS_MISPLACED = "dots misplaced"
    DOT_UNSEEN = "dot unseen"
    SYMMETRIC_DOTS = "symmetric dots"
    # the table
    TABLE_VIEW = "table view"  # the board of the declared view does not lie where the disc rolls
    BOARD_THICKNESS = "board thickness"
    TABLE_DISAGREES = "table disagrees"  # the disc does not roll on the board's, beyond the tolerances of both
    # the cameras
    EXCHANGED = "exchanged cameras"
    MIRRORED = "mirrored images"
    HANDEDNESS = "handedness"
    CAMERA_MOVED = "camera moved"
    CAMERAS_CONTRADICT = "cameras contradict each other"
    ONE_SIDED = "one camera only"  # the dots of the other make no sense
    DOTS_MISFIT = "dots misfit"  # in all frames, by more than their own scatter
    DOTS_SCATTER = "dots scatter"
    POSES_SCATTER = "poses scatter"
    EXPOSURE = "exposure"
    SENSOR = "sensor"  # colour filter, stuck pixels
    LIGHT = "light"  # clipped, or none
    SHARPNESS = "sharpness"
    ACCURACY = "accuracy"
    # the clock
    DELAY = "delay"
    DROPPED_FRAMES = "dropped frames"  # by one camera
    CLOCK_JUMP = "clock jump"  # pairs lost by both cameras
    REPEATED_IMAGES = "repeated images"
    TIME_STAMPS = "time stamps"
    # the files, and the rest
    READING = "reading"  # how the frames are read
    HEADERS = "camera headers"
    UNREADABLE = "unreadable images"
    FRAMES_LOST = "frames lost"
    DISC_NOT_FOUND = "disc not found"
    DECLARATION = "declaration"
    CALIBRATION = "calibration"  # and views of the board that it does not use
    ANALYSIS = "analysis"
    DIAGNOSIS = "diagnosis"
    OTHER = "other"  # and of a file that another version wrote

    @classmethod
    def _missing_(cls, value: object) -> Kind:
        """A kind that this version does not know."""
        return cls.OTHER


# What else is noticed where two images that are not of one instant, or places that are not the dots', make a pose;
MISFITS = (
    Kind.DOTS_MISFIT, Kind.DOTS_SCATTER, Kind.POSES_SCATTER, Kind.CAMERAS_CONTRADICT, Kind.ONE_SIDED,
    Kind.TABLE_DISAGREES, Kind.SHARPNESS, Kind.ACCURACY, Kind.FRAMES_LOST,
)  # fmt: skip
# and where the images are not those of the declared cameras at all, so that no pose is right
NONSENSE = (
    *MISFITS, Kind.SQUARE, Kind.DIAMETER, Kind.RADIUS, Kind.THICKNESS, Kind.GRAVITY_OR_RATE,
    Kind.REVERSED, Kind.DOTS_MISPLACED, Kind.DOT_UNSEEN, Kind.TABLE_VIEW, Kind.BOARD_THICKNESS, Kind.DELAY,
    Kind.DROPPED_FRAMES, Kind.CLOCK_JUMP, Kind.CAMERA_MOVED, Kind.DISC_NOT_FOUND,
)  # fmt: skip


@dataclass(frozen=True)
class Remedy:
    """What would mend it: a declared number with the one that would fit, or what to do."""

    key: str = ""  # as in recording.toml
    fits: str = ""  # what the key would have to be, in its unit
    declared: str = ""
    action: str = ""  # or a remark on the number

    def __str__(self) -> str:
        declared = f" (declared {self.declared})" if self.declared else ""
        would = f": {self.fits} would fit{declared}" if self.fits else declared
        return f"{self.key}{would}{', ' if self.key and self.action else ''}{self.action}"


@dataclass(frozen=True)
class Subject:
    """What it is about, as far as it is about less than the whole recording."""

    stage: str = ""  # name of a command: check, calibrate, track, analyse, diagnose
    camera: str = ""  # left or right
    frames: tuple[tuple[int, int], ...] = ()  # first and last of each stretch
    view: int | None = None  # of the calibration, counted from 0
    dot: int | None = None  # of [markers], counted from 0


@dataclass(frozen=True)
class Finding:
    """Something noticed."""

    kind: Kind
    severity: Severity
    text: str  # what was seen, one sentence without its full stop; for people only
    subject: Subject = Subject()
    numbers: Mapping[str, Measured] = field(default_factory=dict)
    remedies: tuple[Remedy, ...] = ()  # likeliest first
    explains: tuple[Kind, ...] = ()  # consequences: not told beside this one

    @property
    def sentence(self) -> str:
        """What to change first, then what was seen."""
        told = [str(remedy) for remedy in self.remedies]
        if not told:
            return self.text
        if not self.remedies[0].key:
            advice = "; or ".join(told)
            return f"{self.text.removesuffix('.')}. {advice[:1].upper()}{advice[1:]}"
        return f"{'; or '.join(told)}: {self.text}"

    @property
    def grave(self) -> str:
        """How grave it is, in a word."""
        return self.severity.name.lower()

    @property
    def doubtful(self) -> bool:
        """True where the result may be wrong by more than its sigmas."""
        return self.severity >= Severity.DOUBT

    def as_json(self) -> dict[str, Any]:
        """Of JSON's types, with the sentence."""
        words = {"kind": self.kind.value, "severity": self.grave, "sentence": self.sentence}
        return {**asdict(self), **words, "explains": [kind.value for kind in self.explains]}


def of_kind(kind: Kind, severity: Severity, texts: Iterable[str]) -> tuple[Finding, ...]:
    """Findings of which no more is known than their sentences."""
    return tuple(Finding(kind, severity, text) for text in texts)


def finding_from_json(document: Mapping[str, Any]) -> Finding:
    """The finding that `as_json` wrote; a kind that this version does not know is OTHER."""
    subject = dict(document["subject"])
    return Finding(
        Kind(document["kind"]),
        Severity[document["severity"].upper()],
        document["text"],
        Subject(**{**subject, "frames": tuple((first, last) for first, last in subject["frames"])}),
        {name: _number(**number) for name, number in document["numbers"].items()},
        tuple(Remedy(**remedy) for remedy in document["remedies"]),
        tuple(Kind(value) for value in document["explains"]),
    )


def _number(value: float, sigma: float | None, unit: str) -> Measured:
    return Measured(value, unit=unit) if sigma is None or sigma != sigma else Measured(value, sigma, unit)


def leading(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The causes alone, one line each, gravest first: no finding explains them; each as grave as what it explains."""
    rest: list[Finding] = []
    for finding in sorted(findings, key=lambda f: -f.severity):
        rest += [finding] if finding not in rest else []
    found = []
    while rest:
        cause = next((f for f in rest if not any(_explains(g, f) for g in rest)), rest[0])
        folded, kinds = [cause], set(cause.explains)
        while more := [f for f in rest if f.kind in kinds and f not in folded]:
            folded += more
            kinds |= {kind for f in more for kind in f.explains}
        rest = [f for f in rest if f not in folded]
        found.append(replace(cause, severity=max(f.severity for f in folded)))
    return tuple(sorted(found, key=lambda finding: -finding.severity))


def _explains(one: Finding, other: Finding) -> bool:
    return one.kind != other.kind and other.kind in one.explains


def carried(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Of a measurement, the causes that the stages after it repeat: all but notes."""
    return tuple(finding for finding in leading(findings) if finding.severity > Severity.NOTE)


def doubts(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The causes that put a result in doubt."""
    return tuple(finding for finding in leading(findings) if finding.doubtful)


def in_doubt(findings: Iterable[Finding]) -> bool:
    """True where a result with these findings may be wrong by more than its sigmas."""
    return any(finding.doubtful for finding in findings)


class DoubtWarning(UserWarning):
    """A result that may be wrong by more than its sigmas; for Python, as commands have words of their own."""


def warn_of_doubts(findings: Iterable[Finding]) -> None:
    """A Python warning for each cause that puts the result in doubt, at the line that called one of the packages."""
    within = ("disctrack", "calibration", "contextlib")  # the last decorates functions of ours
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in within:
        level, frame = level + 1, frame.f_back
    for finding in doubts(findings):
        warnings.warn(finding.sentence, DoubtWarning, stacklevel=level)
