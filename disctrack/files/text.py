"""Text from outside (file names, values of a recording.toml) made safe for terminals, pages and spreadsheets."""

import unicodedata


def printable(text: str) -> str:
    """The text with control characters escaped: they could move a terminal's cursor, or set its title."""
    return "".join(c.encode("unicode_escape").decode() if unicodedata.category(c) in _CONTROL else c for c in text)


_CONTROL = ("Cc", "Cs", "Zl", "Zp")  # controls, surrogates (from undecodable file names), line separators


def csv_cell(value: object) -> object:
    """A cell for a spreadsheet: an apostrophe prevents text from being a formula; None becomes empty."""
    if not isinstance(value, str):
        return "" if value is None else value
    shown = printable(value)
    return f"'{shown}" if shown.startswith(("=", "+", "-", "@")) else shown
