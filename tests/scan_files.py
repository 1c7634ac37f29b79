"""Pile files that the tests write, and the refusal of one."""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wlplan import io
from wlplan.errors import InputError
from wlplan.types import Pile


def save(path: Path, fields: Mapping[str, Any]) -> Path:
    np.savez(path, **fields)
    return path


def refused(path: Path, match: str, **arguments: Any) -> str:
    """Check that reading a pile fails with one line that names the file."""
    with pytest.raises(InputError, match=match) as error:
        io.read_pile(path, **arguments)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    return str(error.value)


def points_of(pile: Pile, random: np.random.Generator, n: int = 60_000) -> np.ndarray:
    """A point cloud of a pile: random places, bilinear would be overkill for what is tested."""
    i, j = (random.integers(0, size, n) for size in pile.height.shape)
    x, y = (np.asarray(pile.origin)[axis] + 0.1 * k for axis, k in ((0, i), (1, j)))
    return np.stack([x, y, np.asarray(pile.height)[i, j]], axis=-1).astype(np.float64)


def write_tif(
    path: Path,
    band: np.ndarray,
    *,
    step: float = 0.1,
    west: float = 100.0,
    north: float = 200.0,
    **options: Any,
) -> Path:
    rasterio = pytest.importorskip("rasterio")
    transform = options.pop("transform", rasterio.Affine(step, 0.0, west, 0.0, -step, north))
    profile = {
        "driver": "GTiff",
        "count": 1,
        "dtype": band.dtype,
        "transform": transform,
        **options,
    }
    with rasterio.open(path, "w", height=band.shape[0], width=band.shape[1], **profile) as file:
        file.write(band, 1)
    return path


def write_las(path: Path, points: np.ndarray) -> Path:
    laspy = pytest.importorskip("laspy")
    if path.suffix == ".laz":
        pytest.importorskip("lazrs")
    cloud = laspy.create()
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(path)
    return path


def write_ply(
    path: Path, points: np.ndarray, encoding: str = "binary_little_endian", extra: str = ""
) -> Path:
    order = ">" if encoding.endswith("big_endian") else "<"
    head = (
        f"ply\nformat {encoding} 1.0\ncomment a scan\nelement vertex {len(points)}\n"
        f"property double x\nproperty float y\nproperty double z\n{extra}end_header\n"
    )
    rows = [(x, y, z) for x, y, z in points]
    if encoding == "ascii":
        body = "\n".join(" ".join(f"{value:.4f}" for value in row) for row in rows).encode()
    else:
        body = b"".join(struct.pack(order + "dfd", *row) for row in rows)
    path.write_bytes(head.encode() + body)
    return path
