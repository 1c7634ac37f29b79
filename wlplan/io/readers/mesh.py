"""`.obj`, `.stl`: meshes of triangles; x, y, z in metres.

Of a mesh its upper surface counts, wherever a face is, however large; an `.obj` without faces is a
point cloud. Where y is up, as it is in most `.obj`, those are turned and a note says so. The
formats have no place for a unit, so a note says what is assumed. Materials and pictures that a file
names are not looked at.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library
from wlplan.io.reference import Reference
from wlplan.io.scans import Box, Heightmap, PointCloud
from wlplan.io.scans import crop as cropped
from wlplan.io.upright import check_upright, turned, turning, up_axis, upright

ENDINGS = (".obj", ".stl")
OPTIONS = ("up", "crop")

# Bytes before the faces of a binary STL, which end with their number, and of a face.
_STL_HEAD, _STL_FACE = 84, 50
# Points on the faces that show which way is up, and the seed of their places.
_SOME, _SEED = 50_000, 0


def read(path: Path, *, up: str | None = None, crop: Box | None = None) -> Heightmap | PointCloud:
    """Read the faces and put their upper surface on a grid.

    Args:
        path: File to read.
        up: Axis of the file that is up; by default z, for `.obj` else y, if the shape says so.
        crop: Rectangle outside of which nothing is read, in the coordinates of the pile.

    Raises:
        InputError: If trimesh is missing, there are no faces, or it is not clear which way is up.
    """
    kind = path.suffix.lower().removeprefix(".")
    content = _content(path.read_bytes(), kind)
    _, _, notes = Reference().factors()
    with library("trimesh", install="wlplan[scan]") as trimesh:
        load = trimesh.exchange.load.mesh_loaders[kind]
        # Without a resolver no other file is looked for.
        found = load(io.BytesIO(content), file_type=kind, resolver=None, skip_materials=True)
    parts = list(found["geometry"].values()) if "geometry" in found else [found]
    corners = [np.asarray(part["vertices"], float)[part["faces"]] for part in parts if _faces(part)]
    if not corners:
        vertices = [np.asarray(part["vertices"], float) for part in parts if "vertices" in part]
        if not vertices:
            raise InputError("has no faces and no points: export the surface as triangles.")
        points = np.concatenate(vertices).reshape(-1, 3)
        cloud = upright(PointCloud(points, notes=notes), up)
        return cloud if crop is None else cropped(cloud, crop)
    triangles = np.concatenate(corners)
    triangles = triangles[np.isfinite(triangles).all(axis=(1, 2))]
    if not len(triangles):
        raise InputError("has no faces with numbers as corners: export it again.")
    if up is None:
        up = up_axis(_on_faces(triangles))
        if not (kind == "obj" and up == "y"):
            check_upright(up)
            up = None
    if up is not None:
        triangles = turned(triangles.reshape(-1, 3), up).reshape(-1, 3, 3)
        notes = (*notes, *turning(up))
    from wlplan.io.surfaces import upper_surface

    height, seen, cell, origin = upper_surface(triangles, crop)
    return Heightmap(height, cell, origin, None if seen.all() else seen, notes=notes)


def _content(content: bytes, kind: str) -> bytes:
    """What the library is given: text in UTF-8, whatever its names and remarks are written in."""
    if kind == "stl" and len(content) >= _STL_HEAD:
        count = int.from_bytes(content[_STL_HEAD - 4 : _STL_HEAD], "little")
        if len(content) == _STL_HEAD + count * _STL_FACE:
            return content
    if kind == "stl" and not content.lstrip()[:5].lower() == b"solid":
        raise InputError("is damaged or cut short, or no STL file: copy or export it again.")
    return content.decode("utf-8", "replace").encode()


def _faces(part: dict[str, Any]) -> bool:
    """Whether a part of a file has faces."""
    return part.get("faces") is not None and len(part["faces"]) > 0


def _on_faces(triangles: np.ndarray) -> np.ndarray:
    """Points spread evenly over faces, shape [t, 3, 3], as many as say which way is up."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas = np.linalg.norm(np.cross(first, second), axis=-1)
    total = areas.sum()
    if not 0.0 < total < np.inf:
        return triangles[:, 0]
    random = np.random.default_rng(_SEED)
    chosen = random.choice(len(triangles), _SOME, p=areas / total)
    u, v = random.uniform(size=(2, _SOME, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    places: np.ndarray = triangles[chosen, 0] + u * first[chosen] + v * second[chosen]
    return places
