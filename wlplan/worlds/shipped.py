"""The worlds that come with the package, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from wlplan.errors import InputError
from wlplan.models.storage import load_model, read_description
from wlplan.plugins import load_object
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.presets import check_machine, check_soil
from wlplan.site.soil import GRAVEL, Soil
from wlplan.types import World
from wlplan.worlds.learned import LearnedWorld
from wlplan.worlds.names import WORLDS, Engine
from wlplan.worlds.pile_states import Strip


def pretrained_path(name: str) -> Path:
    """Directory of the weights that ship with the package."""
    return Path(str(resources.files("wlplan") / "pretrained" / name))


def load_world(
    name: str,
    *,
    model: str | Path | None = None,
    pile_state: str | Path | None = None,
    stall: str | Path | None = None,
    soil: Soil = GRAVEL,
    machine: WheelLoader = WA320,
) -> World:
    """A world by name.

    Args:
        name: "low" (ψ_low and the automaton), "hybrid" (ψ_high and the automaton), "high" (ψ_high
            and φ) or "simulator". "simulator-lane" is the same with the soil that lies in the
            approach lane. "dem" is the discrete-element engine, which takes minutes a loading, has
            no derivative, and needs `pip install 'wlplan[dem]'`.
        model: Directory of a trained ψ, of either kind, instead of the one that ships.
        pile_state: Directory of a trained φ, of either kind, instead of the one that ships, or of
            the strip and the automaton.
        stall: Directory of a trained predictor of stalls instead of the one that ships. That is
            left out where `model` is given: it knows the soil and the machine of its own training.
        soil: What is dug. A learned world takes from it the density, by which it turns mass into
            volume, and the angle of repose; what it predicts is for the soil of its training.
        machine: What digs. A learned world takes from it the width of the bucket.

    Raises:
        InputError: If the name is unknown, a model is missing or unusable, or soil or machine make
            no sense.
    """
    check_soil(soil)
    check_machine(machine)
    if not isinstance(name, str) or name not in WORLDS:
        raise InputError(f"unknown world {name!r}: choose one of {', '.join(WORLDS)}.")
    recipe = WORLDS[name]
    if isinstance(recipe, Engine):
        if any(given is not None for given in (model, pile_state, stall)):
            raise InputError(f"the world {name!r} has no models: leave them out.")
        engine: World = load_object(recipe.maker)(machine=machine, soil=soil)
        return engine
    psi = _model(recipe.performance if model is None else Path(model), _PERFORMANCE)
    place = recipe.pile_state if pile_state is None else Path(pile_state)
    phi: Any = Strip() if place is None else _model(place, _PILE_STATE)
    risk = None
    if stall is not None or model is None:
        risk = _model(recipe.stall if stall is None else Path(stall), _STALL)
    return LearnedWorld(psi, phi, machine=machine, soil=soil, stall=risk)


# Kinds of models in each place of a learned world, and what makes them.
_PERFORMANCE, _PILE_STATE, _STALL = ("psi_low", "psi_high"), ("phi", "phi_vae"), ("stall",)


def _model(place: str | Path, kinds: tuple[str, ...]) -> Any:
    """A model that ships, by its name, or one in a directory."""
    folder = pretrained_path(place) if isinstance(place, str) else place
    kind = read_description(folder, kind=None)["kind"]
    if kind not in kinds:
        makers = " or ".join(f"`wlplan train {k.replace('_', '-')}`" for k in kinds)
        raise InputError(f"{folder}: is a {kind}: name a model that {makers} made.")
    return load_model(folder, kind)
