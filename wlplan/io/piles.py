"""Piles on disk.

The world frame of a scan is its own, x east, y north, z up, in metres. Coordinates of a survey are
too large for float32, so whole kilometres are taken off x and y when the map lies more than 10 km
from zero, and whole hundreds of metres off z when its lowest point is more than 100 m from zero:
the last digits of the survey's coordinates stay as they are.
"""

from __future__ import annotations

import dataclasses
import io
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.io.contents import Contents
from wlplan.io.files import write_bytes_atomic
from wlplan.io.survey import read_survey
from wlplan.site.frame import Frame
from wlplan.types import Pile
from wlplan.xla import on_device


@dataclasses.dataclass(frozen=True)
class ScannedPile:
    """What was read from a file.

    Attributes:
        pile: The pile, on the grid of the models, in its local frame.
        frame: How that lies to the coordinates of the file, and their reference system.
        notes: What was assumed, converted or left out, in words: sentences without their stops.
        contents: Structures, piles and areas; the ground of the pile holds all that is not dug.
        scanned_cell: Side of the cells before they were put on the grid of the models [m].
    """

    pile: Pile
    frame: Frame
    notes: tuple[str, ...]
    contents: Contents
    scanned_cell: float


def read_pile(
    path: str | os.PathLike[str],
    *,
    ground: Float[Array | np.ndarray, "nx ny"] | float | str | os.PathLike[str] | None = None,
    **options: Any,
) -> Pile:
    """Read a pile and resample it to the grid spacing of the models, 0.1 m.

    As `read_scan`, whose notes go unsaid.

    Args:
        path: As there.
        ground: As there.
        options: As there.

    Returns:
        The pile on the 0.1 m grid, with its ground.

    Raises:
        InputError: If the file cannot be used; one line that says why and what to do.
    """
    return read_scan(path, ground=ground, **options).pile


def read_scan(
    path: str | os.PathLike[str],
    *,
    ground: Float[Array | np.ndarray, "nx ny"] | float | str | os.PathLike[str] | None = None,
    **options: Any,
) -> ScannedPile:
    """Read a pile, with what is worth knowing of its file.

    The ending of the name decides the format. Height maps are `.npz`, GeoTIFF, ESRI ASCII grids and
    the maps of grid_map in recordings of ROS; point clouds LAS, LAZ, PLY, PCD, E57 and text; meshes
    OBJ and STL. Lengths in other units are converted to metres where the file names them. The
    modules of `wlplan.io.readers`, one for each format, say what a file has to hold;
    `wlplan.io.register_reader` takes more of them. The height of a cell of a point cloud is the
    median of its points, that of a mesh its highest face; cells without any are unseen, but for
    single ones amid seen cells.

    Unseen cells are filled smoothly from seen ones; a fill that the file brings is kept where it
    lies within the range of the seen heights. Coordinates far from zero: see the module.

    Args:
        path: File to read.
        ground: Floor under the pile [m] in the file's frame: a level, a map on the grid of the
            file, or the path of a scan of the floor in the same coordinates, in any format that is
            read; where that one saw nothing the floor is estimated. By default that of the file,
            else `terrain.floor.estimate_ground` finds it around the toe. It is lowered to the
            surface wherever it lies above.
        options: `crop`, the rectangle that is read: x and y of two opposite corners, in the
            coordinates of the file. `up`, the axis of a point cloud or mesh that is up, such as
            "y", which is turned to be z before anything else, the crop too. Others are for the
            reader of the format, which names them in `OPTIONS`: `band` of a GeoTIFF, `layer` of a
            grid_map. And, in the coordinates of the scan in metres, `keep_out`, a GeoJSON file of
            areas; `truck_area`, one of the areas that trucks may stand in; `include`, x and y of a
            structure that is soil; `pile`, x and y of the pile that is dug, by default the largest;
            asked for, it is the only one that is soil.

    Returns:
        The pile on the 0.1 m grid, with its ground, and the notes.

    Raises:
        InputError: If the file cannot be used; one line that says why and what to do.
    """
    read: Any = ground
    if isinstance(ground, jax.Array):
        read = np.asarray(ground)
    survey = read_survey(path, ground=read, dtype=jnp.zeros(()).dtype, **options)
    grid = survey.grid
    pile = Pile(
        height=on_device(grid.height),
        cell_size=grid.cell_size,
        origin=on_device(grid.origin),
        ground=None if grid.ground is None else on_device(grid.ground),
        valid=None if grid.valid is None else on_device(grid.valid),
    )
    return ScannedPile(pile, survey.frame, survey.notes, survey.contents, survey.scanned_cell)


def write_pile(path: str | os.PathLike[str], pile: Pile) -> None:
    """Write one pile as .npz, in the format of `read_pile`, in one piece or not at all.

    The ground is always written, so that reading does not estimate it anew.

    Raises:
        InputError: If the name does not end in .npz or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError(f"{path}: piles are written as .npz: choose a name with that ending.")
    fields: dict[str, Any] = {
        "height": np.asarray(pile.height),
        "cell_size": np.float64(pile.cell_size),
        "origin": np.asarray(pile.origin),
        "ground": np.asarray(pile.floor),
    }
    if pile.valid is not None:
        fields["valid"] = np.asarray(pile.valid)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **fields)
    write_bytes_atomic(path, buffer.getvalue())
