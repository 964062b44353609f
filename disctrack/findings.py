"""Findings about a measurement, as data.

Each stage creates a `Finding` with a sentence; later stages read kinds, severities and numbers, never the text.
`leading` removes findings that another one explains.
"""

import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum, IntEnum
from typing import Any

from disctrack.numbers import Measured


class Severity(IntEnum):
    """How serious a finding is; a command that reports a doubt ends with exit code 3, a refusal with 1."""

    NOTE = 0  # for information
    WARNING = 1  # the result is less accurate than possible, but within the stated sigmas
    DOUBT = 2  # the result may be wrong by more than the stated sigmas
    REFUSAL = 3  # there is no result


class Kind(Enum):
    """Kind of a finding; the value is written to files."""

    # the declaration
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
    TABLE_VIEW = "table view"  # the board of the declared view does not lie on the table
    BOARD_THICKNESS = "board thickness"
    TABLE_DISAGREES = "table disagrees"  # the disc rolls on another plane than the board's, beyond both tolerances
    # the cameras
    EXCHANGED = "exchanged cameras"
    MIRRORED = "mirrored images"
    HANDEDNESS = "handedness"
    CAMERA_MOVED = "camera moved"
    CAMERAS_CONTRADICT = "cameras contradict each other"
    ONE_SIDED = "one camera only"  # the dots of the other camera are implausible
    DOTS_MISFIT = "dots misfit"  # in all frames, by more than their intrinsic scatter
    DOTS_SCATTER = "dots scatter"
    POSES_SCATTER = "poses scatter"
    EXPOSURE = "exposure"
    SENSOR = "sensor"  # colour filter, stuck pixels
    LIGHT = "light"  # overexposed, or none
    SHARPNESS = "sharpness"
    ACCURACY = "accuracy"
    # the clock
    DELAY = "delay"
    DROPPED_FRAMES = "dropped frames"  # by one camera
    CLOCK_JUMP = "clock jump"  # image pairs dropped by both cameras
    REPEATED_IMAGES = "repeated images"
    TIME_STAMPS = "time stamps"
    # the files, and others
    READING = "reading"  # of the frames
    HEADERS = "camera headers"
    UNREADABLE = "unreadable images"
    FRAMES_LOST = "frames lost"
    DISC_NOT_FOUND = "disc not found"
    DECLARATION = "declaration"
    CALIBRATION = "calibration"  # also views of the board that are not used
    ANALYSIS = "analysis"
    DIAGNOSIS = "diagnosis"
    OTHER = "other"  # also a kind from a file of another version

    @classmethod
    def _missing_(cls, value: object) -> "Kind":
        """OTHER for a kind that this version does not know."""
        return cls.OTHER


# Consequences if a pose is fitted to images of different instants, or to positions that are not those of the dots;
MISFITS = (
    Kind.DOTS_MISFIT, Kind.DOTS_SCATTER, Kind.POSES_SCATTER, Kind.CAMERAS_CONTRADICT, Kind.ONE_SIDED,
    Kind.TABLE_DISAGREES, Kind.SHARPNESS, Kind.ACCURACY, Kind.FRAMES_LOST,
)  # fmt: skip
# and if the images are not of the declared cameras, so that no pose is correct
NONSENSE = (
    *MISFITS, Kind.SQUARE, Kind.DIAMETER, Kind.RADIUS, Kind.THICKNESS, Kind.GRAVITY_OR_RATE,
    Kind.REVERSED, Kind.DOTS_MISPLACED, Kind.DOT_UNSEEN, Kind.TABLE_VIEW, Kind.BOARD_THICKNESS, Kind.DELAY,
    Kind.DROPPED_FRAMES, Kind.CLOCK_JUMP, Kind.CAMERA_MOVED, Kind.DISC_NOT_FOUND,
)  # fmt: skip


@dataclass(frozen=True)
class Remedy:
    """How to correct it: a declared number with the one that would fit, or an action."""

    key: str = ""  # as in recording.toml
    fits: str = ""  # the value of the key that would fit, in its unit
    declared: str = ""
    action: str = ""  # or a remark on the number

    def __str__(self) -> str:
        declared = f" (declared {self.declared})" if self.declared else ""
        would = f": {self.fits} would fit{declared}" if self.fits else declared
        return f"{self.key}{would}{', ' if self.key and self.action else ''}{self.action}"


@dataclass(frozen=True)
class Subject:
    """The part of the recording that a finding is about; by default all of it."""

    stage: str = ""  # name of a command: check, calibrate, track, analyse, diagnose
    camera: str = ""  # left or right
    frames: tuple[tuple[int, int], ...] = ()  # first and last of each stretch
    view: int | None = None  # of the calibration, counted from 0
    dot: int | None = None  # of [markers], counted from 0


@dataclass(frozen=True)
class Finding:
    """An observation about a measurement."""

    kind: Kind
    severity: Severity
    text: str  # the observation, a sentence without full stop; for people only
    subject: Subject = Subject()
    numbers: Mapping[str, Measured] = field(default_factory=dict)
    remedies: tuple[Remedy, ...] = ()  # most likely first
    explains: tuple[Kind, ...] = ()  # its consequences, which are not reported in addition

    @property
    def sentence(self) -> str:
        """The remedy, then the observation."""
        remedies = [str(remedy) for remedy in self.remedies]
        if not remedies:
            return self.text
        if not self.remedies[0].key:
            advice = "; or ".join(remedies)
            return f"{self.text.removesuffix('.')}. {advice[:1].upper()}{advice[1:]}"
        return f"{'; or '.join(remedies)}: {self.text}"

    @property
    def grave(self) -> str:
        """The severity in a word."""
        return self.severity.name.lower()

    @property
    def doubtful(self) -> bool:
        """True if the result may be wrong by more than its sigmas."""
        return self.severity >= Severity.DOUBT

    def as_json(self) -> dict[str, Any]:
        """The finding in types of JSON, with its sentence."""
        words = {"kind": self.kind.value, "severity": self.grave, "sentence": self.sentence}
        return {**asdict(self), **words, "explains": [kind.value for kind in self.explains]}


def of_kind(kind: Kind, severity: Severity, texts: Iterable[str]) -> tuple[Finding, ...]:
    """Findings that consist only of a sentence."""
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
    """Only the causes, most severe first: no other finding explains them. Each has the severity of its consequences."""
    rest: list[Finding] = []
    for finding in sorted(findings, key=lambda f: -f.severity):
        rest += [finding] if finding not in rest else []
    found = []
    while rest:
        cause = next((f for f in rest if not any(f.kind in g.explains and f.kind != g.kind for g in rest)), rest[0])
        folded, kinds = [cause], set(cause.explains)
        while more := [f for f in rest if f.kind in kinds and f not in folded]:
            folded += more
            kinds |= {kind for f in more for kind in f.explains}
        rest = [f for f in rest if f not in folded]
        found.append(replace(cause, severity=max(f.severity for f in folded)))
    return tuple(sorted(found, key=lambda finding: -finding.severity))


def carried(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The causes that later stages repeat: all except notes."""
    return tuple(finding for finding in leading(findings) if finding.severity > Severity.NOTE)


def doubts(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The causes that put a result in doubt."""
    return tuple(finding for finding in leading(findings) if finding.doubtful)


def in_doubt(findings: Iterable[Finding]) -> bool:
    """True if a result with these findings may be wrong by more than its sigmas."""
    return any(finding.doubtful for finding in findings)


class DoubtWarning(UserWarning):
    """A result that may be wrong by more than its sigmas; commands print findings instead."""


def warn_of_doubts(findings: Iterable[Finding]) -> None:
    """A Python warning for each cause that puts the result in doubt, at the line of the caller outside our packages."""
    within = ("disctrack", "calibration", "contextlib")  # the last wraps functions of ours
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in within:
        level, frame = level + 1, frame.f_back
    for finding in doubts(findings):
        warnings.warn(finding.sentence, DoubtWarning, stacklevel=level)
