"""The worlds that come with the package, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, no_type_check

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import KG_PER_TONNE
from wlplan.engines.dem.world import DiscreteElements
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.models.pile_state import PileStatePredictor
from wlplan.models.storage import load_model, read_description
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.presets import check_machine, check_soil
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import DEFAULT_SCHEDULE, Schedule, settle_dug, window_of
from wlplan.terrain.automaton.windows import paste
from wlplan.terrain.excavation import excavate
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    add_local_change,
    local_points,
    sample,
    sample_local,
)
from wlplan.types import Action, LocalHeightmap, Performance, Pile, Pose, World, action_vector

WORLDS = ("low", "high", "hybrid", "simulator")
"""Names that `load_world` knows, to plan in."""
ENGINES = ("simulator", "dem")
"""Names that `load_world` knows, to play plans in; "dem" is too slow to plan in."""

MODELS = {"low": ("psi_low",), "hybrid": ("psi_high",), "high": ("psi_high", "phi")}
"""The models of each learned world, by the names under which they ship."""


@no_type_check
class LowWorld(struct.PyTreeNode):
    """The low-dimensional world: ψ_low, mass removal along the strip, automaton. Paper, 4.6."""

    model: PerformanceModel | Ensemble
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where the strip holds less than the model predicts, the load is what is there.
        """
        predicted = self.model(sample_local(pile, pose), action_vector(action))
        return _dug_and_settled(self, pile, pose, predicted)

    def uncertainty(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """Standard deviation of the error of the performance, see `_deviation`."""
        return _deviation(self.model, sample_local(pile, pose), action)


@no_type_check
class HybridWorld(struct.PyTreeNode):
    """The hybrid world: ψ_high, mass removal along the strip, automaton. Paper, 4.6."""

    model: PerformanceModel | Ensemble
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where the strip holds less than the model predicts, the load is what is there.
        """
        predicted = self.model(sample_local(pile, pose), action_vector(action))
        return _dug_and_settled(self, pile, pose, predicted)

    def uncertainty(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """Standard deviation of the error of the performance, see `_deviation`."""
        return _deviation(self.model, sample_local(pile, pose), action)


@no_type_check
class HighWorld(struct.PyTreeNode):
    """The high-dimensional world: ψ_high and φ. Paper, section 4.6.

    With φ of ours exactly the mass that it reports leaves the pile. φ of the paper changes the pile
    by whatever volume it predicts, and the mass is that of ψ_high.

    With `settle` the automaton lets the predicted surface slide, which keeps its volume: a pile
    that was within the schedule's tolerance of the angle of repose is so afterwards. Over 8
    held-out rollouts of 30 loads that takes 71 ms in place of 29, and leaves a pile that differs
    from the simulator's by 3.0 m³ in place of 6.6, at most 33° steep in place of 83°.
    """

    model: PerformanceModel | Ensemble
    pile_state: PileStatePredictor
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)
    settle: bool = struct.field(pytree_node=False, default=True)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where there is less than the model predicts, the load is what is there.
        """
        vector = action_vector(action)
        predicted = self.model(sample_local(pile, pose), vector)
        local = sample_local(pile, pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT)
        window, start = window_of(pile, pose)
        per_volume = self.soil.density / KG_PER_TONNE
        ground = local.height - _above_floor(pile, pose)
        change = self.pile_state(local, vector, predicted.mass / per_volume, ground)
        height = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
        if self.settle:
            after = settle_dug(
                pile,
                height,
                start,
                repose_angle=self.soil.repose_angle,
                schedule=self.schedule,
            )
        else:
            after = pile.replace(height=paste(pile.height, height, jnp.stack(start)))
        if self.pile_state.conserves_volume:
            left = (window.height - height).sum() * pile.cell_size**2
            predicted = predicted.replace(mass=left * per_volume)
        return after, predicted

    def uncertainty(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """Standard deviation of the error of the performance, see `_deviation`."""
        return _deviation(self.model, sample_local(pile, pose), action)


def _deviation(
    model: PerformanceModel | Ensemble,
    local: LocalHeightmap,
    action: Action,
) -> Performance:
    """Standard deviation of the error of a predicted performance [tonne, s, kJ].

    It is that of one loading on the pile as given, whatever came before, and of what the model
    predicts: where less is there to be loaded, it does not shrink. Differentiable.

    Raises:
        InputError: If the model is no ensemble.
    """
    if not isinstance(model, Ensemble):
        raise InputError(
            "the model of this world is a single one and does not predict its own error: "
            "train an ensemble with `wlplan train --members 5`"
        )
    return model.with_deviation(local, action_vector(action))[1]


def _above_floor(pile: Pile, pose: Pose) -> Float[Array, "52 52"]:
    """Height of the pile over its floor, on the cells of the local map of the pile state [m]."""
    points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
    return sample(pile.height - pile.floor, pile, *points)


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
        name: "low" (ψ_low and the automaton), "hybrid" (ψ_high and the automaton), "high" (ψ_high
            and φ) or "simulator". "dem" is the discrete-element engine, which takes minutes a
            loading, has no derivative, and needs `pip install 'wlplan[dem]'`.
        model: Directory of a trained ψ to use in place of the one that ships.
        pile_state: For "high", directory of a trained φ, of either kind, likewise.
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
    if name in MODELS:
        psi, *others = MODELS[name]
        predictor: Any = load_model(pretrained_path(psi) if model is None else model, psi)
        if name == "low":
            return LowWorld(predictor, machine=machine, soil=soil)
        if name == "hybrid":
            return HybridWorld(predictor, machine=machine, soil=soil)
        place = pretrained_path(others[0]) if pile_state is None else Path(pile_state)
        phi: Any = load_model(place, read_description(place, kind=None)["kind"])
        if not isinstance(phi, PileStatePredictor):
            raise InputError(f"{place}: is not a pile state model: name one of `train phi`.")
        return HighWorld(predictor, phi, machine=machine, soil=soil)
    raise InputError(
        f"unknown world {name!r}; choose one of {', '.join(dict.fromkeys((*WORLDS, *ENGINES)))}"
    )
