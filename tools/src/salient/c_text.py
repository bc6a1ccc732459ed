"""Texts of C and C++: comments, and code without them."""

from __future__ import annotations

import re

TOKEN = re.compile(r"""R"\([\s\S]*?\)"|"(?:\\.|[^"\\\n])*"|'(?:\\[^'\n]*|[^'\\\n])'"""
                   r"""|(?P<comment>/\*[\s\S]*?\*/|//[^\n]*(?:\n[ \t]*//[^\n]*)*)""")
"""A literal, or a comment as the group `comment`: those with // on successive lines are one."""


def code(text: str) -> str:
    """The lines without comments and without white space at their ends, as far as something is left: equal for sources
    that differ in comments and indentation alone."""
    lines = TOKEN.sub(lambda token: " " if token["comment"] else token[0], text).splitlines()
    return "\n".join(stripped for line in lines if (stripped := line.strip()))
