"""The pile that a plan leaves as GeoTIFF: heights in metres, as the scan has them."""

from __future__ import annotations

import numpy as np

from wlplan.io.files import MADE_BY
from wlplan.report.exports import Played
from wlplan.site.frame import frame_recorded

LIBRARY = "rasterio"
NAME = "pile_after.tif"
_UNSEEN = -9999.0


def content(played: Played) -> bytes:
    """The file. What was not seen has no data."""
    import rasterio

    document, after = played.document, played.after
    frame, size = frame_recorded(document), after.cell_size
    height = np.asarray(after.height, np.float64) + frame.offset[2]
    if after.valid is not None:
        height = np.where(np.asarray(after.valid), height, _UNSEEN)
    # The origin is the middle of a cell; the rows of a raster go from north to south.
    x, y = frame.scan(*(float(value) for value in np.asarray(after.origin)))
    north = y + size * (height.shape[1] - 0.5)
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=height.shape[0],
            height=height.shape[1],
            count=1,
            dtype="float32",
            crs=frame.crs,
            transform=rasterio.Affine(size, 0.0, x - 0.5 * size, 0.0, -size, north),
            nodata=_UNSEEN,
            compress="deflate",
        ) as file:
            file.update_tags(TIFFTAG_SOFTWARE=MADE_BY)
            file.write(height.T[::-1].astype(np.float32), 1)
        content: bytes = memory.read()
    return content
