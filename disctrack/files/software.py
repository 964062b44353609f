"""Which software makes a result."""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from pathlib import Path

import calibration
import disctrack
from calibration.sources import sources_sha256

# Rooms beside the measurement: what they make is never reused, nor part of what is.
_BESIDE = ("docs", "examples", "first_look", "render", "repeats", "validate")


@cache
def software_version() -> str:
    """The version, and the sources that were in use when it was first asked for: "0.2.0+3f9c0e62a1b4".

    The number is set by hand; code that changes results must not find those of other code, so the sources count.
    """
    home = Path(str(disctrack.__file__)).parent
    sources = sources_sha256(Path(str(calibration.__file__)).parent) + sources_sha256(home, _BESIDE)
    return f"{disctrack.__version__}+{sha256(sources.encode()).hexdigest()[:12]}"
