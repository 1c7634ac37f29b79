"""What the pages share: one HTML file each that needs nothing beside it and opens in any browser.

`base.html.j2` says what all pages have and in which order; the template of a page extends it.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import gzip
from collections.abc import Sequence
from importlib import resources
from typing import Any

from jinja2 import ChainableUndefined, Environment, PackageLoader

from wlplan.constants import QUANTITIES
from wlplan.errors import shown
from wlplan.report import said
from wlplan.report.figures.key import KeyLine


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture of a page.

    Attributes:
        png: Content of the file.
        alt: What is seen, for who does not see it.
    """

    png: bytes
    alt: str

    @property
    def source(self) -> str:
        """The picture as part of the page."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode('ascii')}"


@dataclasses.dataclass(frozen=True)
class Gallery:
    """Pictures that belong together; side by side where there is room.

    Attributes:
        title: Of the section.
        pictures: In the order of reading.
        columns: Side by side at most.
        key: What lines and colours mean.
        caption: A sentence below the title, with its stop.
        small: Whether two of them stand side by side on a phone, too.
    """

    title: str
    pictures: Sequence[Picture]
    columns: int = 1
    key: Sequence[KeyLine] = ()
    caption: str = ""
    small: bool = False


def rendered(template: str, *, scene: object, **values: Any) -> str:
    """A page as HTML. Every text is escaped, and what is missing becomes a dash.

    Args:
        template: Name of the file.
        scene: What is shown in three dimensions, values of JSON; None: nothing.
        **values: What the template asks for.
    """
    return (
        _environment()
        .get_template(template)
        .render(
            scene=scene,
            plotly=None if scene is None else _plotly(),
            quantities=QUANTITIES,
            **values,
        )
    )


@functools.cache
def _plotly() -> str:
    """The library that draws in three dimensions, as it is in its package: gzip, in base64."""
    source = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, mtime=0)).decode("ascii")


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        autoescape=True,
        # A name of a file may hold what is no character.
        finalize=lambda value: shown(value) if type(value) is str else value,
        loader=PackageLoader("wlplan", "report"),
        undefined=ChainableUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {name: getattr(said, name) for name in said.__all__}
    return environment
