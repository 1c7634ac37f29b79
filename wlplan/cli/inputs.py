"""What the commands take in: checks that need nothing heavy, the pile, the world, the receiver."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlplan.cli.options import BUNDLED
from wlplan.cli.outputs import remark
from wlplan.errors import InputError
from wlplan.site.machine import MACHINES, WA320, WheelLoader
from wlplan.site.presets import machine_named, machine_recorded, soil_named, soil_recorded
from wlplan.site.soil import GRAVEL, SOILS, Soil

if TYPE_CHECKING:
    from jaxtyping import Array

    from wlplan.planning.transport import Receiver
    from wlplan.types import Pile, World

RECEIVER_FIELDS = ("x", "y", "heading")
"""Fields of a receiver in plan.json."""

# Farthest that a truck may stand from the middle of the map [m].
_FARTHEST_TRUCK = 500.0


@dataclasses.dataclass(frozen=True)
class Site:
    """What is dug and what digs, each with the name that it goes by."""

    soil_name: str = "gravel"
    soil: Soil = GRAVEL
    machine_name: str = "wa320"
    machine: WheelLoader = WA320

    def fields(self) -> dict[str, Any]:
        """What plan.json and the like say about it: names, and all values in SI units."""
        return {
            "soil": {"name": self.soil_name, "parameters": dataclasses.asdict(self.soil)},
            "machine": {"name": self.machine_name, "parameters": dataclasses.asdict(self.machine)},
        }


def check_pile_name(name: str) -> None:
    """Refuses what cannot be a pile file, before anything heavy is imported.

    Raises:
        InputError: If it is missing, a folder, or of an unknown kind.
    """
    from wlplan.io.readers import find_reader

    if name == BUNDLED:
        return
    if os.path.isdir(name):
        raise InputError(f"{name}: is a folder: name the pile file itself.")
    if not os.path.exists(name):
        raise InputError(f"{name}: no such pile file: check the name.")
    find_reader(Path(name))


def check_models(model: str | None, pile_state: str | None, world: str) -> None:
    """Refuses models that are no folders, or that the world does not take.

    Raises:
        InputError: If so.
    """
    for name, option, takers in (
        (model, "--model", ("low", "high", "hybrid")),
        (pile_state, "--pile-state", ("high",)),
    ):
        if name is None:
            continue
        if world not in takers:
            raise InputError(f"{option} does not go with --world {world}: leave one of them out.")
        check_is_folder(name, "model", "wlplan train")


def model_fields(model: str | None, pile_state: str | None) -> dict[str, str]:
    """What plan.json and the like say about models in place of those that ship."""
    given = {"model": model, "pile_state": pile_state}
    return {name: path for name, path in given.items() if path is not None}


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
    from wlplan.terrain.toe import toe_contour

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


def site_named(soil: str | None, machine: str | None, *, otherwise: Site = Site()) -> Site:
    """The soil and the machine of the options.

    Args:
        soil: Name of a preset or of a TOML file, None if the option is not given.
        machine: Likewise.
        otherwise: What counts where an option is not given.

    Raises:
        InputError: If one of them is unknown or makes no sense.
    """
    site = otherwise
    if soil is not None:
        site = dataclasses.replace(site, soil_name=soil, soil=soil_named(soil))
    if machine is not None:
        site = dataclasses.replace(site, machine_name=machine, machine=machine_named(machine))
    return site


def site_recorded(document: Mapping[str, Any], file: str) -> Site:
    """The soil and the machine that a document recorded; the presets where it has none.

    Args:
        document: Content of a plan.json.
        file: Its name, for complaints.

    Raises:
        InputError: If what it says about them cannot be used.
    """
    try:
        site = Site()
        if "soil" in document:
            name, parameters = _record(document, "soil")
            site = dataclasses.replace(site, soil_name=name, soil=soil_recorded(parameters))
        if "machine" in document:
            name, parameters = _record(document, "machine")
            machine = machine_recorded(parameters)
            site = dataclasses.replace(site, machine_name=name, machine=machine)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    return site


def _record(document: Mapping[str, Any], part: str) -> tuple[str, object]:
    """Name and parameters of what a document recorded."""
    record = document[part]
    if not isinstance(record, dict) or not isinstance(record.get("name"), str):
        raise InputError(f"{part} has no name: write the plan again.")
    return record["name"], record.get("parameters")


def world_named(
    name: str, site: Site, model: str | None = None, pile_state: str | None = None
) -> World:
    """A world of `WORLDS` at a site.

    Tells on stderr if it is learned and a model of it was trained for another site.

    Args:
        name: Name of the world.
        site: What is dug and what digs.
        model: Folder of a ψ in place of the one that ships with the package.
        pile_state: Folder of a φ likewise, for the high world.
    """
    from wlplan.worlds.library import MODELS, load_world

    # Only the high world asks for it.
    second = {} if pile_state is None else {"pile_state": pile_state}
    world = load_world(name, model=model, soil=site.soil, machine=site.machine, **second)
    for kind, given in zip(MODELS.get(name, ()), (model, pile_state), strict=False):
        if _remark_on_training(kind, given, site):
            break
    return world


def _remark_on_training(kind: str, model: str | None, site: Site) -> bool:
    """Tell if a model was trained for another soil or machine than those of a site."""
    from wlplan.models.storage import read_description
    from wlplan.worlds.library import pretrained_path

    folder = pretrained_path(kind) if model is None else Path(model)
    data = read_description(folder, None).get("dataset")
    data = data if isinstance(data, dict) else {}
    trained = {part: data.get(part) for part in ("soil", "machine")}
    # A description may say nothing of them: data of one's own do not have to.
    others = [
        name
        for part, name, values in (
            ("soil", site.soil_name, site.soil),
            ("machine", site.machine_name, site.machine),
        )
        if isinstance(trained[part], dict) and not _agree(trained[part], values)
    ]
    if others:
        soil = _name_among(SOILS, trained["soil"], "another soil")
        machine = _name_among(MACHINES, trained["machine"], "another machine")
        machine = f"the {machine.upper()}" if machine in MACHINES else machine
        remark(
            f"the model was trained for {soil} and {machine}, not for {' and '.join(others)}: "
            f"what it predicts is for those"
        )
    return bool(others)


def _name_among(presets: Mapping[str, Any], recorded: Any, otherwise: str) -> str:
    """Name of the preset that has recorded values."""
    found = (name for name, preset in presets.items() if _agree(recorded, preset))
    return next(found, otherwise)


def _agree(recorded: Any, values: Soil | WheelLoader) -> bool:
    """Whether recorded values are those; a field that was not recorded had no say yet."""
    return isinstance(recorded, dict) and all(
        recorded.get(name, value) == value for name, value in dataclasses.asdict(values).items()
    )


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

    from wlplan.planning.transport import Receiver, default_receiver
    from wlplan.terrain.heightmap import sample

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
    above = pile.height - pile.floor
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

    from wlplan.planning.transport import Receiver, v_turn_length
    from wlplan.studies.diggability import edge_poses
    from wlplan.terrain.toe import toe_contour

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
