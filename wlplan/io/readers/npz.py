"""`.npz`: the arrays of a height map as numpy saves them; the format of `wlplan.write_pile`.

`height` [nx, ny] [m], `cell_size` [m], optional `origin` [2] [m] (centre of cell [0, 0], by default
zero), `valid` bool [nx, ny] and `ground` [nx, ny] [m]. Axis 0 is x, axis 1 is y. Without `valid`,
cells whose height is NaN are unseen.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from wlplan.errors import InputError
from wlplan.io.limits import check_unpacked
from wlplan.io.scans import Heightmap, real_numbers

ENDINGS = (".npz",)

_MAGIC = b"\x93NUMPY"


def read(path: Path) -> Heightmap:
    """Read the arrays; none of them may need pickle.

    Raises:
        InputError: If `height` or `cell_size` is missing, the latter is no number, or a field holds
            objects.
    """
    with path.open("rb") as file:
        start = file.read(6)
        if start == _MAGIC:
            raise InputError("holds a single array: save it by np.savez with height and cell_size.")
        if not start.startswith(b"PK"):
            raise InputError("is no .npz file: save it by np.savez with height and cell_size.")
        with zipfile.ZipFile(file) as archive:
            # It unpacks no further than to the sizes that it says.
            check_unpacked(sum(member.file_size for member in archive.infolist()))
            # Every field is read here, so that damage shows up here.
            fields = {
                name.removesuffix(".npy"): _array(archive, name) for name in archive.namelist()
            }
    for name in ("height", "cell_size"):
        if name not in fields:
            raise InputError(
                f"has no field `{name}`, only {sorted(fields)}: save `height` [nx, ny] in metres "
                f"and `cell_size` in metres."
            )
    cell_size = real_numbers("cell_size", fields["cell_size"])
    if cell_size.size != 1:
        raise InputError(f"`cell_size` has shape {cell_size.shape}: it has to be one number.")
    valid = fields.get("valid")
    if valid is None and (unseen := np.isnan(real_numbers("height", fields["height"]))).any():
        valid = ~unseen
    return Heightmap(
        height=fields["height"],
        cell_size=float(cell_size.reshape(())),
        origin=fields.get("origin", np.zeros(2)),
        valid=valid,
        ground=fields.get("ground"),
    )


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An array of an archive; numpy itself would give out anything else as bytes."""
    field = name.removesuffix(".npy")
    with archive.open(name) as member:
        if not member.read(len(_MAGIC)) == _MAGIC:
            raise InputError(f"has a field `{field}` that is no array: save it by np.savez.")
        member.seek(0)
        try:
            array: np.ndarray = np.lib.format.read_array(member, allow_pickle=False)
        except ValueError as error:
            if "Object arrays" not in str(error):
                raise
            raise InputError("holds Python objects: save plain arrays of numbers.") from error
    return array
