"""Reading a page of HTML as a browser would, for the tests of the report."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """A page whose tags are closed in order: its tags, its words, and what it would load."""

    tags: list[str]
    links: list[str | None]
    alts: list[str | None]
    scopes: int
    text: str

    def __init__(self, source: str) -> None:
        super().__init__()
        self._open: list[str] = []
        self.tags, self.links, self.alts, self.scopes, self.text = [], [], [], 0, ""
        self.feed(source)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the tag and what it refers to."""
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "srcset", "href")]
        self.alts += [value for name, value in attrs if name == "alt"]
        self.scopes += sum(name == "scope" for name, _ in attrs)
        if tag not in ("meta", "img", "br", "link", "input"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """The tag that was opened last is closed first."""
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Collect words; those of the style sheet and of scripts are none."""
        if self._open[-1:] not in (["style"], ["script"]):
            self.text += data
