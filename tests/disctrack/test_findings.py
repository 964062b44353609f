"""Findings: the cause is told first, once, and with the number that would fit; two digits of a sigma."""

import json
from dataclasses import replace

import pytest

from disctrack import findings
from disctrack.findings import Finding, Kind, Remedy, Severity, Subject, leading
from disctrack.numbers import Measured

NOISE = Finding(Kind.POSES_SCATTER, Severity.WARNING, "poses scatter")
MISFIT = Finding(Kind.DOTS_MISFIT, Severity.DOUBT, "dots miss their places", explains=(Kind.POSES_SCATTER,))
THERE = Subject("check", frames=((3, 7), (9, 9)))
BOTH = Remedy("left, right", action="exchange the two patterns")
OF_THAT = {"remedies": (BOTH,), "explains": (Kind.DOTS_MISFIT, Kind.ONE_SIDED)}
EXCHANGED = Finding(Kind.EXCHANGED, Severity.DOUBT, "the left and right images are exchanged", THERE, **OF_THAT)
SCALE = {"scale": Measured(0.98765, 0.001)}
MENDED = Remedy("square_mm", "8.00", "8.1"), Remedy("centres_mm", action="multiply by 0.988")
FARTHER = "the dots are 0.9877 ± 0.0010 times as far apart as declared"
SQUARE = Finding(Kind.SQUARE, Severity.DOUBT, FARTHER, numbers=SCALE, remedies=MENDED)


def test_the_cause_comes_first_and_its_consequences_are_left_out():
    assert leading([NOISE, MISFIT, SQUARE, EXCHANGED, NOISE]) == (SQUARE, EXCHANGED)
    assert leading([NOISE]) == (NOISE,)


def test_a_cause_is_as_grave_as_what_it_explains():
    delay = Finding(Kind.DELAY, Severity.NOTE, "a camera lags", explains=(Kind.DOTS_MISFIT,))
    assert leading([delay, MISFIT]) == (replace(delay, severity=Severity.DOUBT),)
    assert findings.in_doubt([MISFIT])
    assert not findings.in_doubt([delay])


def test_of_two_that_explain_each_other_the_first_is_told():
    one = Finding(Kind.RADIUS, Severity.DOUBT, "a", explains=(Kind.THICKNESS,))
    other = Finding(Kind.THICKNESS, Severity.DOUBT, "b", explains=(Kind.RADIUS,))
    assert leading([one, other]) == (one,)


def test_the_sentence_begins_with_what_to_type():
    assert SQUARE.sentence.startswith("square_mm: 8.00 would fit (declared 8.1); or centres_mm, multiply by 0.988: the")
    assert NOISE.sentence == "poses scatter"


def test_a_finding_comes_back_from_json_as_it_was():
    for finding in (NOISE, MISFIT, EXCHANGED, SQUARE):
        assert findings.finding_from_json(json.loads(json.dumps(finding.as_json()))) == finding
    later = findings.finding_from_json({**NOISE.as_json(), "kind": "of a later version"})
    assert later.kind == Kind.OTHER


def test_doubts_are_python_warnings_and_their_consequences_are_not():
    with pytest.warns(findings.DoubtWarning) as told:
        findings.warn_of_doubts([MISFIT, EXCHANGED, NOISE])
    assert [str(w.message) for w in told] == [EXCHANGED.sentence]
