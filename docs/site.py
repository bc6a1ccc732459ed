"""Hook of MkDocs: `sh untested` marks a block that tests/tools/test_readme.py does not run; a site has no such language."""

from typing import Any


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The text of a page as MkDocs reads it."""
    return markdown.replace("```sh untested\n", "```sh\n")
