"""Text from outside (names of files, words of a recording.toml) as terminals, pages and spreadsheets may show it."""

import unicodedata


def printable(text: str) -> str:
    """The text with its control characters as escapes: they move a terminal's cursor, or set its title."""
    return "".join(c.encode("unicode_escape").decode() if unicodedata.category(c) in _CONTROL else c for c in text)


_CONTROL = ("Cc", "Cs", "Zl", "Zp")  # controls, halves of characters (names that are no Unicode), ends of lines


def csv_cell(value: object) -> object:
    """A cell that a spreadsheet shows as it is: text that would be a formula gets an apostrophe; None is empty."""
    if not isinstance(value, str):
        return "" if value is None else value
    shown = printable(value)
    return f"'{shown}" if shown.startswith(("=", "+", "-", "@")) else shown
