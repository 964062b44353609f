"""Which software makes a result."""

from functools import cache
from hashlib import sha256
from pathlib import Path

__version__ = "0.2.0"

# Rooms beside the measurement: what they make is never reused, nor part of what is.
_BESIDE = ("examples", "first_look", "render", "repeats", "validate")


@cache
def software_version() -> str:
    """The version, and the sources that were in use when it was first asked for: "0.2.0+3f9c0e62a1b4".

    The number is set by hand; code that changes results must not find those of other code, so the sources count.
    """
    import calibration  # NumPy: the command line asks for the number alone, before it tells NumPy its threads
    from calibration.sources import sources_sha256

    home = Path(__file__).parents[1]
    sources = sources_sha256(Path(str(calibration.__file__)).parent) + sources_sha256(home, _BESIDE)
    return f"{__version__}+{sha256(sources.encode()).hexdigest()[:12]}"
