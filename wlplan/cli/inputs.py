"""What the commands take in: checks that need nothing heavy, the pile, the site, the world."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlplan.cli.options import BUNDLED, READING, UPS, PileFile
from wlplan.cli.outputs import remark
from wlplan.errors import InputError
from wlplan.planning import planners
from wlplan.planning.named import NamedPile, NamedSite, checksum, read_named
from wlplan.planning.objectives import OBJECTIVES
from wlplan.plugins import load_object
from wlplan.site.machine import MACHINES, WheelLoader
from wlplan.site.presets import machine_named, machine_recorded, soil_named, soil_recorded
from wlplan.site.soil import SOILS, Soil
from wlplan.worlds.names import WORLDS, Learned

if TYPE_CHECKING:
    from wlplan.types import World


# Gravel and the WA320.
_PRESETS = NamedSite()


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
    for name, option in ((model, "--model"), (pile_state, "--pile-state")):
        if name is None:
            continue
        if not isinstance(WORLDS.get(world), Learned):
            raise InputError(f"{option} does not go with --world {world}: leave one of them out.")
        check_is_folder(name, "model", "wlplan train")


def model_fields(model: str | None, pile_state: str | None) -> dict[str, str]:
    """What plan.json and the like say about models that do not ship."""
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


def pile_named(file: PileFile, machine: WheelLoader) -> NamedPile:
    """A pile with its toe; notes on the file go to stderr.

    Args:
        file: The pile file and how it is read.
        machine: What digs.

    Raises:
        InputError: If it cannot be read or dug.
    """
    path = _path_of(file)
    name = f"{BUNDLED} ({path.name})" if file.name == BUNDLED else file.name
    return read_named(path, file.reading, machine, name=name, note=remark)


def read_as_recorded(file: PileFile, record: object) -> PileFile:
    """A pile file, with the options of reading that a plan recorded and that are not given anew.

    Args:
        file: As it was asked for.
        record: What the plan says about its pile. If that is another file, nothing is taken over.

    Raises:
        InputError: If an option that it records is of another kind.
    """
    if not isinstance(record, dict):
        return file
    kept = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in record.items()
        if name in READING and name not in file.reading
    }
    for name, value in kept.items():
        if not _RECORDED[name](value):
            raise InputError(f"the pile of the plan has a {name} that is none: give --{name} anew.")
    if not kept or record.get("sha256") != checksum(_path_of(file)):
        return file
    options = ", ".join(f"--{name.replace('_', '-')}" for name in kept)
    remark(f"the pile is read as the plan was made, with its {options}")
    return PileFile(file.name, {**kept, **file.reading})


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _are_numbers(count: int) -> Callable[[object], bool]:
    """Whether a value is so many numbers."""

    def check(value: object) -> bool:
        return isinstance(value, tuple) and len(value) == count and all(map(_is_number, value))

    return check


def _is_name(value: object) -> bool:
    return isinstance(value, str)


# What a plan may record of how its pile was read, by the option.
_RECORDED: dict[str, Callable[[object], bool]] = {
    "band": lambda value: isinstance(value, int) and _is_number(value),
    "crop": _are_numbers(4),
    "layer": _is_name,
    "up": lambda value: value in UPS,
    "ground": lambda value: _is_name(value) or _is_number(value),
    "pile": _are_numbers(2),
    "keep_out": _is_name,
    "truck_area": _is_name,
    "include": _are_numbers(2),
}


def _path_of(file: PileFile) -> Path:
    from wlplan.io import bundled_pile_path

    return bundled_pile_path() if file.name == BUNDLED else Path(file.name)


def site_named(
    soil: str | None, machine: str | None, *, otherwise: NamedSite = _PRESETS
) -> NamedSite:
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


def site_recorded(document: Mapping[str, Any], file: str) -> NamedSite:
    """The soil and the machine that a document recorded; the presets where it has none.

    Args:
        document: Content of a plan.json.
        file: Its name, for complaints.

    Raises:
        InputError: If what it says about them cannot be used.
    """
    try:
        site = NamedSite()
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
    name: str, site: NamedSite, model: str | None = None, pile_state: str | None = None
) -> World:
    """A world by name, at a site, or one that somebody else wrote.

    Remarks on stderr if it is learned and a model of it was trained for another site.

    Args:
        name: Name of the world, or `package.module:function`.
        site: What is dug and what digs.
        model: Folder of a ψ instead of the one that ships with the package.
        pile_state: Folder of a φ likewise.
    """
    from wlplan.worlds.shipped import load_world

    if name not in WORLDS:
        world: World = _outside(name)
        return world
    world = load_world(
        name, model=model, pile_state=pile_state, soil=site.soil, machine=site.machine
    )
    recipe = WORLDS[name]
    if isinstance(recipe, Learned):
        models = (recipe.performance, model), (recipe.pile_state, pile_state)
        for kind, given in models:
            if (kind or given) and _remark_on_training(kind, given, site):
                break
    return world


def planner_named(name: str) -> Any:
    """A planner by name as it is, or one that somebody else wrote."""
    return name if name in planners.NAMES else planners.checked(_outside(name))


def objective_named(name: str) -> Any:
    """An objective by name as it is, or one that somebody else wrote."""
    return name if name in OBJECTIVES else _outside(name)


def _outside(reference: str) -> Any:
    """What `package.module:Name` names; of a class an instance with its defaults.

    The folder where the command is run is searched last, so that nothing in it stands in for a
    module that is installed.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    found = load_object(reference)
    if not isinstance(found, type):
        return found
    try:
        return found()
    except TypeError as error:
        raise InputError(
            f"{reference}: cannot be made without arguments ({error}): give all its settings "
            f"defaults, or name a value."
        ) from error


def _remark_on_training(kind: str | None, model: str | None, site: NamedSite) -> bool:
    """Remarks if a model was trained for another soil or machine than those of a site."""
    from wlplan.models.storage import read_description
    from wlplan.worlds.shipped import pretrained_path

    folder = pretrained_path(str(kind)) if model is None else Path(model)
    data = read_description(folder, None).get("dataset")
    data = data if isinstance(data, dict) else {}
    trained = {part: data.get(part) for part in ("soil", "machine")}
    # A description may say nothing about them: your own data need not.
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
            f"its predictions hold for what it was trained for"
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
