"""Examples of docstrings are blocks of code on the pages, however far they are indented."""

import re
import textwrap
from typing import Any

import griffe


class CodeBlocks(griffe.Extension):
    """Indents what begins with a prompt, up to the next empty line."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for each object with its docstring."""
        if obj.docstring:
            text = obj.docstring.value
            obj.docstring.value = re.sub(
                r"(?m)^>>> .+(?:\n.+)*", lambda example: textwrap.indent(example[0], "    "), text
            )
