"""What the items of the benchmark share: how one is described, its result, and its cases."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.actions import latin_hypercube
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.planning.rollout import rollout
from wlplan.studies.bench.digs import Dig, random_digs, relaxed_seed_piles
from wlplan.studies.bench.timing import Timed, Timing, compiled, timed
from wlplan.terrain.automaton import settle, settle_dug
from wlplan.terrain.seed_piles import SEED_PILES
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import LoadingPlan, Pile, Pose, World, action_from
from wlplan.worlds.shipped import load_world

LOADS = 40
"""Loads of a rollout."""

_CONE = SEED_PILES.index(("conical", math.radians(30.0)))


@dataclasses.dataclass(frozen=True)
class Measured:
    """What an item found."""

    compile: float | None = None  # [s]
    run: Timing | None = None
    figures: Mapping[str, float] = dataclasses.field(default_factory=dict)
    note: str = ""  # why nothing was measured


@dataclasses.dataclass(frozen=True)
class Item:
    """Something to measure, and what it should come to."""

    name: str
    title: str
    measure: Callable[[Setup], Measured]
    group: str
    reference: str = ""  # what others take
    target: str = ""  # as the limits say it
    # Figures, or "run" for the median [s], that may be no more, and no less.
    most: Mapping[str, float] = dataclasses.field(default_factory=dict)
    least: Mapping[str, float] = dataclasses.field(default_factory=dict)
    long: bool = False  # left out when it has to be quick

    def met(self, measured: Measured) -> bool | None:
        """Whether the target was reached; None if there is none or nothing was measured."""
        if measured.run is None or not (self.most or self.least):
            return None
        found = {**measured.figures, "run": measured.run.median}
        return all(found[name] <= limit for name, limit in self.most.items()) and all(
            found[name] >= limit for name, limit in self.least.items()
        )


class Setup:
    """What the items share, made when it is first asked for.

    Args:
        seed: Of piles, poses and actions.
        quick: Fewer cases and repeats.
    """

    def __init__(self, *, seed: int, quick: bool):
        self.seed = seed
        self.quick = quick

    def timed(
        self, functions: Sequence[Callable[..., Any]], cases: Sequence[tuple[Any, ...]]
    ) -> list[Timed]:
        """`timing.timed` for about three seconds, or half of one."""
        seconds, least = (0.5, 2) if self.quick else (3.0, 5)
        return timed(functions, cases, seconds=seconds, least=least)

    @functools.cached_property
    def digs(self) -> list[Dig]:
        """Random digs on the seed piles."""
        return random_digs(12 if self.quick else 60, self.seed)

    @property
    def baseline_digs(self) -> list[Dig]:
        """The first of them, for automata that take long; all seed piles are among them."""
        return self.digs[: 6 if self.quick else 24]

    @functools.cached_property
    def piles(self) -> list[Pile]:
        """The relaxed seed piles."""
        return relaxed_seed_piles(self.seed)

    @property
    def cone(self) -> Pile:
        """The pile of the rollouts and the plans: a cone of 30 degrees."""
        return self.piles[_CONE]

    @functools.cached_property
    def world(self) -> World:
        """The low world."""
        return load_world("low")

    @functools.cached_property
    def settle(self) -> tuple[Callable[..., Any], float]:
        """`automaton.settle` of a window, compiled, and the time that took [s]."""
        return compiled(lambda window: settle(window).pile, self.digs[0].dug)

    @functools.cached_property
    def settle_dug(self) -> tuple[Callable[..., Any], float]:
        """`automaton.settle_dug` of a dig, compiled, and the time that took [s]."""
        return compiled(after_a_load, *loaded(self.digs[0]))

    @functools.cached_property
    def rollout(self) -> tuple[Callable[..., Any], float]:
        """The rollout of `plan` in the low world, compiled, and the time that took [s]."""
        return compiled(rollout, self.world, self.cone, self.plan)

    def plans(self, count: int) -> LoadingPlan:
        """Plans around the toe of the cone in random order, random actions; leaves [count, 40]."""
        rng = np.random.default_rng([self.seed, 1])
        poses = edge_poses(toe_contour(self.cone), LOADS)
        orders = np.stack([rng.permutation(LOADS) for _ in range(count)])
        return LoadingPlan(
            Pose(*(floats(np.asarray(v)[orders]) for v in (poses.x, poses.y, poses.heading))),
            action_from(random_actions(count * LOADS, rng).reshape(count, LOADS, 4)),
        )

    @functools.cached_property
    def plan(self) -> LoadingPlan:
        """One of them, leaves [40]."""
        plan: LoadingPlan = jax.tree.map(lambda leaf: leaf[0], self.plans(1))
        return plan


def floats(values: Any) -> Array:
    """Values as float32, the precision that everything is measured in."""
    return jnp.asarray(values, jnp.float32)


def random_actions(count: int, rng: np.random.Generator) -> Float[Array, "n 4"]:
    """Actions that fill their box evenly."""
    low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
    return floats(low + (high - low) * latin_hypercube(count, 4, rng))


def stacked(members: Sequence[Any]) -> Any:
    """Pytrees as one, along a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def loaded(dig: Dig) -> tuple[Pile, Array, tuple[Array, Array]]:
    """What `after_a_load` takes."""
    return dig.pile, dig.dug.height, dig.start


def after_a_load(pile: Pile, dug: Array, start: tuple[Array, Array]) -> Array:
    """The surface of the whole grid once it has slid [m]."""
    return settle_dug(pile, dug, start).pile.height
