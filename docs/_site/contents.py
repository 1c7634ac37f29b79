"""Makes the table of contents of the site from the tables that readers of the raw pages see.

A table whose first column is called "page" names pages below the page that it is on; the heading
above it is their caption. So a new page needs a row there, and nothing else.
"""

import posixpath
import re
from typing import Any

ROW = re.compile(r"^\| \[[^]]+\]\(([^)#]+)\.md\)")


def pages_below(name: str, text: str) -> dict[str, list[str]]:
    """Caption -> the pages that the tables of a page name, from the root of the sources."""
    found: dict[str, list[str]] = {}
    caption, listed = "", False
    for line in text.splitlines():
        if heading := re.match(r"##+ (.*)", line):
            caption = heading[1]
        if not line.startswith("|"):
            listed = False
        elif line.startswith("| page |"):
            listed = True
        elif listed and (row := ROW.match(line)):
            page = posixpath.normpath(posixpath.join(posixpath.dirname(name), row[1]))
            found.setdefault(caption, []).append(page)
    return found


def add_toctrees(app: Any, name: str, source: list[str]) -> None:
    """Adds a hidden toctree for each table of pages."""
    for caption, pages in pages_below(name, source[0]).items():
        options = [":hidden:", *([f":caption: {caption}"] if caption else [])]
        lines = ["", "```{toctree}", *options, "", *(f"/{page}" for page in pages), "```", ""]
        source[0] += "\n".join(lines)


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    app.connect("source-read", add_toctrees)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
