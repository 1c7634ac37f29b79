"""The worlds that come with the package, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, no_type_check

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.automaton import DEFAULT_SCHEDULE, Schedule, settle_dug, window_of
from wlplan.automaton.windows import paste
from wlplan.characteristics import as_vector, characteristics
from wlplan.dem.world import DiscreteElements
from wlplan.errors import InputError
from wlplan.excavation import excavate
from wlplan.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    add_local_change,
    local_points,
    sample,
    sample_local,
)
from wlplan.machine import GRAVEL, WA320, Soil, WheelLoader
from wlplan.models.height_change import HeightChangeModel
from wlplan.models.performance import PerformanceModel
from wlplan.models.performance_high import HighPerformanceModel
from wlplan.models.pile_state import PileStateModel
from wlplan.presets import check_machine, check_soil
from wlplan.simulator import Simulator
from wlplan.training import load_model, read_description
from wlplan.types import Action, Performance, Pile, Pose, World, action_vector
from wlplan.units import KG_PER_TONNE

WORLDS = ("low", "high", "hybrid", "simulator")
"""Names that `load_world` knows, to plan in."""
ENGINES = ("simulator", "dem")
"""Names that `load_world` knows, to play plans in; "dem" is too slow to plan in."""


@no_type_check
class LowWorld(struct.PyTreeNode):
    """The low-dimensional world: ψ_low, mass removal along the strip, automaton. Paper, 4.6."""

    model: PerformanceModel
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where the strip holds less than the model predicts, the load is what is there.
        """
        local = characteristics(sample_local(pile, pose))
        predicted = self.model(as_vector(local), action_vector(action))
        return _dug_and_settled(self, pile, pose, predicted)


@no_type_check
class HybridWorld(struct.PyTreeNode):
    """The hybrid world: ψ_high, mass removal along the strip, automaton. Paper, 4.6."""

    model: HighPerformanceModel
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where the strip holds less than the model predicts, the load is what is there.
        """
        predicted = self.model(sample_local(pile, pose), action_vector(action))
        return _dug_and_settled(self, pile, pose, predicted)


@no_type_check
class HighWorld(struct.PyTreeNode):
    """The high-dimensional world: ψ_high and φ. Paper, section 4.6.

    With φ of ours exactly the mass that it reports leaves the pile. φ of the paper changes the pile
    by whatever volume it predicts, and the mass is that of ψ_high.
    """

    model: HighPerformanceModel
    pile_state: HeightChangeModel | PileStateModel
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where there is less than the model predicts, the load is what is there.
        """
        vector = action_vector(action)
        predicted = self.model(sample_local(pile, pose), vector)
        local = sample_local(pile, pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT)
        window, start = window_of(pile, pose)
        per_volume = self.soil.density / KG_PER_TONNE
        exact = isinstance(self.pile_state, HeightChangeModel)
        if isinstance(self.pile_state, HeightChangeModel):
            volume = predicted.mass / per_volume
            ground = local.height - _above_floor(pile, pose)
            change = self.pile_state(local, vector, volume, ground)
        else:
            change = self.pile_state(local, vector) - local.height
        height = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
        after = pile.replace(height=paste(pile.height, height, jnp.stack(start)))
        if exact:
            left = (window.height - height).sum() * pile.cell_size**2
            predicted = predicted.replace(mass=left * per_volume)
        return after, predicted


def _above_floor(pile: Pile, pose: Pose) -> Float[Array, "52 52"]:
    """Height of the pile over its floor, on the cells of the local map of the pile state [m]."""
    floor = jnp.zeros_like(pile.height) if pile.ground is None else pile.ground
    points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
    return sample(pile.height - floor, pile, *points)


def _dug_and_settled(
    world: LowWorld | HybridWorld, pile: Pile, pose: Pose, predicted: Performance
) -> tuple[Pile, Performance]:
    """Takes the predicted mass out of the strip in front of the bucket and lets the rest slide."""
    window, start = window_of(pile, pose)
    per_volume = world.soil.density / KG_PER_TONNE
    dug, volume = excavate(
        window, pose, predicted.mass / per_volume, width=world.machine.bucket_width
    )
    after = settle_dug(
        pile, dug.height, start, repose_angle=world.soil.repose_angle, schedule=world.schedule
    )
    return after, predicted.replace(mass=volume * per_volume)


def pretrained_path(name: str) -> Path:
    """Directory of the weights that ship with the package."""
    return Path(str(resources.files("wlplan") / "pretrained" / name))


def _model_directory(kind: str, world: str, model: str | Path | None) -> Path:
    directory = pretrained_path(kind) if model is None else Path(model)
    if model is None and not directory.is_dir():
        raise InputError(
            f"the {world} world needs {kind}, which does not ship yet: name a trained one, or use "
            f"low or simulator"
        )
    return directory


def load_world(
    name: str,
    *,
    model: str | Path | None = None,
    pile_state: str | Path | None = None,
    soil: Soil = GRAVEL,
    machine: WheelLoader = WA320,
) -> World:
    """A world by name.

    Args:
        name: "low" (ψ_low and the automaton), "hybrid" (ψ_high and the automaton; its weights do
            not ship yet), "high" (ψ_high and φ; nor do those) or "simulator". "dem" is the
            discrete-element engine, which takes minutes a loading, has no derivative, and needs
            `pip install 'wlplan[dem]'`.
        model: Directory of a trained model to use in place of the pretrained one.
        pile_state: For "high", directory of a trained φ, of either kind.
        soil: What is dug. A learned world takes from it the density, by which it turns mass into
            volume, and the angle of repose; what it predicts is for the soil of its training.
        machine: What digs. A learned world takes from it the width of the bucket.

    Raises:
        InputError: If the name is unknown, a model is missing or unusable, or soil or machine make
            no sense.
    """
    check_soil(soil)
    check_machine(machine)
    if name == "simulator":
        return Simulator(machine=machine, soil=soil)
    if name == "dem":
        return DiscreteElements(machine=machine, soil=soil)
    if name == "low":
        directory = pretrained_path("psi_low") if model is None else Path(model)
        low: Any = load_model(directory)
        return LowWorld(low, machine=machine, soil=soil)
    if name == "hybrid":
        directory = _model_directory("psi_high", name, model)
        high: Any = load_model(directory, "psi_high")
        return HybridWorld(high, machine=machine, soil=soil)
    if name == "high":
        psi: Any = load_model(_model_directory("psi_high", name, model), "psi_high")
        place = _model_directory("phi", name, pile_state)
        phi: Any = load_model(place, read_description(place, kind=None)["kind"])
        if not isinstance(phi, HeightChangeModel | PileStateModel):
            raise InputError(f"{place}: is not a pile state model: name one of `train phi`.")
        return HighWorld(psi, phi, machine=machine, soil=soil)
    raise InputError(
        f"unknown world {name!r}; choose one of {', '.join(dict.fromkeys((*WORLDS, *ENGINES)))}"
    )
