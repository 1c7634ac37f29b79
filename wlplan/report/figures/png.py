"""A figure as a PNG file."""

from __future__ import annotations

import io
import os

from matplotlib.figure import Figure
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from wlplan.io import write_bytes_atomic
from wlplan.io.files import MADE_BY


def png_bytes(figure: Figure, *, dpi: int = 150, rare_colours: bool = False) -> bytes:
    """A figure as the content of a PNG file; the same figure gives the same bytes.

    Args:
        figure: What to draw; its empty borders are cut off.
        dpi: Pixels an inch.
        rare_colours: Whether colours of few pixels matter as much as those of many, which then are
            a little coarser.
    """
    buffer = io.BytesIO()
    figure.savefig(
        buffer,
        format="png",
        dpi=dpi,
        bbox_inches="tight",
        pad_inches=0.12,
        metadata={"Software": None},
    )
    # 256 colours look the same, and take a third of the room.
    method = Image.Quantize.MAXCOVERAGE if rare_colours else Image.Quantize.MEDIANCUT
    few = Image.open(buffer).convert("RGB").quantize(256, method, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    said = PngInfo()
    said.add_text("Software", MADE_BY)
    few.save(buffer, format="png", optimize=True, dpi=(dpi, dpi), pnginfo=said)
    return buffer.getvalue()


def save_figure(path: str | os.PathLike[str], figure: Figure, *, dpi: int = 150) -> None:
    """Write a figure as PNG, in one piece or not at all.

    Args:
        path: File to write.
        figure: What to draw, as for `png_bytes`.
        dpi: Pixels an inch.

    Raises:
        InputError: If the file cannot be written.
    """
    write_bytes_atomic(path, png_bytes(figure, dpi=dpi))
