"""The pile that ships with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path


def bundled_pile_path() -> Path:
    """Path of the pile that ships with the package, a published heightmap of a built soil mound."""
    return Path(str(resources.files("wlplan").joinpath("data", "marsyard2022_mound.npz")))
