"""What the commands take in: checks that need nothing heavy, the pile, the world, the receiver."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlplan.cli.options import BUNDLED
from wlplan.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Array

    from wlplan.transport import Receiver
    from wlplan.types import Pile, World

# Endings of the files that `wlplan.io` reads, repeated to keep help fast; a test compares them.
PILE_ENDINGS = (".npz", ".tif", ".tiff", ".las", ".laz", ".ply")

RECEIVER_FIELDS = ("x", "y", "heading")
"""Fields of a receiver in plan.json."""

# Farthest that a truck may stand from the middle of the map [m].
_FARTHEST_TRUCK = 500.0


def check_pile_name(name: str) -> None:
    """Refuses what cannot be a pile file, before anything heavy is imported.

    Raises:
        InputError: If it is missing, a folder, or of an unknown kind.
    """
    if name == BUNDLED:
        return
    if os.path.isdir(name):
        raise InputError(f"{name}: is a folder: name the pile file itself.")
    if not os.path.exists(name):
        raise InputError(f"{name}: no such pile file: check the name.")
    if Path(name).suffix.lower() not in PILE_ENDINGS:
        raise InputError(
            f"{name}: unknown kind of pile file: use one of {', '.join(PILE_ENDINGS)}."
        )


def check_model(name: str | None, world: str) -> None:
    """Refuses a model that is no folder, or that the world does not take.

    Raises:
        InputError: If so.
    """
    if name is None:
        return
    if world != "low":
        raise InputError(f"--model does not go with --world {world}: leave one of them out.")
    check_is_folder(name, "model", "wlplan train")


def check_is_folder(name: str, what: str, maker: str) -> None:
    """Refuses what is missing or a file.

    Args:
        name: Path of the folder.
        what: What it should be, in words.
        maker: Command that makes it.

    Raises:
        InputError: If there is no such folder.
    """
    if not os.path.lexists(name):
        raise InputError(f"{name}: no such {what}: check the name, or make it with `{maker}`.")
    if not os.path.isdir(name):
        raise InputError(f"{name}: is a file: a {what} is a folder, made with `{maker}`.")


def pile_named(name: str) -> tuple[Pile, dict[str, Any]]:
    """A pile, and what plan.json says about it.

    Args:
        name: Path of the pile file, or `BUNDLED`.

    Raises:
        InputError: If it cannot be read or dug.
    """
    from wlplan.io import bundled_pile_path, read_pile
    from wlplan.pile import toe_contour

    path = bundled_pile_path() if name == BUNDLED else Path(name)
    pile = read_pile(path)
    toe_contour(pile)  # a pile that cannot be dug is refused here
    fields = {
        "file": f"{BUNDLED} ({path.name})" if name == BUNDLED else name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "cells": list(pile.height.shape),
        "cell_size": pile.cell_size,
        "origin": [float(value) for value in pile.origin],
    }
    return pile, fields


def world_named(name: str, model: str | None = None) -> World:
    """A world of `WORLDS`, with the model that ships with the package or one from a folder."""
    from wlplan.worlds import load_world

    return load_world(name) if model is None else load_world(name, model=model)


def receiver_at(pile: Pile, truck: tuple[float, ...] | None) -> Receiver:
    """Where the loader dumps.

    Args:
        pile: The pile, in the frame of the scan.
        truck: x [m], y [m] and, if given, heading [degree]; None for the default place.

    Raises:
        InputError: If the place lies on the pile or far away from it.
    """
    import jax.numpy as jnp
    import numpy as np

    from wlplan.heightmap import sample
    from wlplan.pile import ground_height
    from wlplan.transport import Receiver, default_receiver

    if truck is None:
        return default_receiver(pile)
    x, y = truck[:2]
    size = pile.cell_size * np.array(pile.height.shape)
    low = np.asarray(pile.origin, float)
    away = math.hypot(*(np.array([x, y]) - low - 0.5 * size))
    if away > _FARTHEST_TRUCK:
        raise InputError(
            f"--truck {x:g},{y:g} lies {away:.0f} m from the middle of the map, which spans x "
            f"{low[0]:.1f} to {low[0] + size[0]:.1f} and y {low[1]:.1f} to {low[1] + size[1]:.1f} "
            f"m: give it in that frame (whole kilometres of survey coordinates are taken off)."
        )
    dtype = pile.height.dtype
    above = pile.height - ground_height(pile)
    place = [jnp.asarray(value, dtype) for value in (x, y)]
    inside = bool(np.all((np.array([x, y]) >= low) & (np.array([x, y]) <= low + size)))
    if inside and float(sample(above, pile, *place)) > 0.5:
        raise InputError(f"--truck {x:g},{y:g} lies on the pile: give a place beside it.")
    if len(truck) == 3:
        heading = math.remainder(math.radians(truck[2]), 2.0 * math.pi)
    else:
        heading = _heading_of_shortest_ways(pile, place)
    return Receiver(*place, jnp.asarray(heading, dtype))  # type: ignore[call-arg]


def _heading_of_shortest_ways(pile: Pile, place: Sequence[Array]) -> float:
    """Heading [rad] at a place x, y [m] from where the ways to the toe are shortest on average."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from wlplan.diggability import edge_poses
    from wlplan.pile import toe_contour
    from wlplan.transport import Receiver, v_turn_length

    dtype = pile.height.dtype
    poses = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), edge_poses(toe_contour(pile), 24))
    headings = np.radians(np.arange(-180.0, 180.0, 5.0))
    lengths = jax.jit(
        jax.vmap(
            lambda h: jax.vmap(
                lambda pose: v_turn_length(pose, Receiver(*place, h))  # type: ignore[call-arg]
            )(poses).mean()
        )
    )(jnp.asarray(headings, dtype))
    return float(headings[int(np.argmin(lengths))])


def receiver_fields(receiver: Receiver) -> dict[str, float]:
    """What plan.json says about a receiver: x [m], y [m] and heading [rad]."""
    return {name: float(getattr(receiver, name)) for name in RECEIVER_FIELDS}
