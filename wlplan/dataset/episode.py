"""Episodes: which piles are dug where, with which actions, and what is recorded.

An `Episode` is one pile with all that is random about digging it. In a data set the variable
`rollout` holds its number.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.actions import latin_hypercube
from wlplan.constants import ACTION_HIGH, ACTION_LOW, CELL_SIZE
from wlplan.dataset.protocols import PROTOCOLS
from wlplan.dataset.variables import LOADS, VARIABLES, h36_after
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Pile

# What the random streams are for; part of their keys. `PROTOCOLS` has those of the protocols.
_ROLLOUT_STREAM, _ACTION_STREAM = 0, 1
# A filling from this time on is slow [s]: a tenth of all.
_SLOW_FILLING = 4.0


class Episode:
    """A pile, what is random about digging it, and the loadings so far.

    Args:
        number: Number of the episode, which also decides its seed pile.
        seed: Seed of piles, poses and actions.
        loads: Loadings to simulate.
        simulator: The simulator.
        length: Loadings of a whole episode; None: `LOADS`.
        protocol: One of `PROTOCOLS`.
    """

    def __init__(
        self,
        number: int,
        seed: int,
        loads: int,
        simulator: Simulator,
        *,
        length: int | None = None,
        protocol: str = "paper",
    ):
        length = LOADS if length is None else length
        self.number = number
        repeat, self.seed_pile = divmod(number, len(SEED_PILES))
        key = np.random.SeedSequence(seed, spawn_key=(_ROLLOUT_STREAM, number))
        random = np.random.default_rng(key)
        self.noise_seed = int(random.integers(2**31))
        self.place, turn = random.random((2, length))  # [0, 1) along the accessible toe
        self.turn = PROTOCOLS[protocol].turn * (2.0 * turn - 1.0)
        self.draws = PROTOCOLS[protocol].draw(seed, number, length)
        key = np.random.SeedSequence(seed, spawn_key=(_ACTION_STREAM, repeat))
        unit = latin_hypercube(len(SEED_PILES) * length, 4, np.random.default_rng(key))
        low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
        mine = slice(self.seed_pile * length, (self.seed_pile + 1) * length)
        self.action = (low + (high - low) * unit[mine]).astype(np.float32)
        self.loads = loads
        self.simulator = simulator
        self.pose = np.zeros(3, np.float32)
        self.valid = False
        self.loadings: list[dict[str, Any]] = []

    def reset(self) -> None:
        """Makes the pile before the first loading: `height` [m], [nx, ny], and `origin` [m], [2].

        Not part of the construction, since it takes time.
        """
        shape = grid_shape()
        kind, slope = SEED_PILES[self.seed_pile]
        pile = seed_pile(kind, slope=slope, seed=self.noise_seed)
        self.height = compiled_relax(self.simulator.soil.repose_angle)(_on_grid(pile, shape)).height
        self.origin = grid_origin()

    @property
    def load(self) -> int:
        """Number of the next loading."""
        return len(self.loadings)

    def next_loading(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose x, y [m], heading [rad], shape [3], and action, shape [4], of the next loading."""
        pile = Pile(self.height, CELL_SIZE, self.origin)
        shift, variation, past = (draw[self.load] for draw in self.draws)
        near = None if np.isnan(shift).any() else self.pose[:2] + shift
        pose = choose_pose(pile, self.place[self.load], self.turn[self.load], near)
        self.valid = pose is not None
        # A pile that is used up is dug where it was dug last; `valid` tells.
        if pose is not None:
            ahead = past * np.array([np.cos(pose[2]), np.sin(pose[2]), 0.0])
            self.pose = pose + ahead.astype(np.float32)
        if not np.isnan(variation).any():
            slow = [load["action"] for load in self.loadings if load["fill_time"] >= _SLOW_FILLING]
            if slow:
                low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
                similar = np.clip(slow[-1] + (high - low) * variation, low, high)
                self.action[self.load] = similar.astype(np.float32)
        return self.pose, self.action[self.load]

    def add_loading(self, height: Array, outcome: dict[str, Any]) -> None:
        """Records the loading that `next_loading` gave.

        Args:
            height: The surface after it [m], shape [nx, ny].
            outcome: Its simulated variables by name, see `VARIABLES`.
        """
        self.height = height
        maps = (outcome[name] for name in ("h36", "h52", "h52_after"))
        known = {
            "h36_after": h36_after(*maps),
            "action": self.action[self.load],
            "pose": self.pose,
            "valid": self.valid,
            "rollout": self.number,
            "seed_pile": self.seed_pile,
            "load": self.load,
        }
        self.loadings.append(outcome | known)

    def records(self) -> dict[str, np.ndarray]:
        """The variables of all loadings so far, see `VARIABLES`; the first axis is the loading."""
        return {
            name: np.stack([load[name] for load in self.loadings]).astype(variable.dtype)
            for name, variable in VARIABLES.items()
        }


def choose_pose(
    pile: Pile, place: float, turn: float, near: Float[np.ndarray, "2"] | None = None
) -> Float[np.ndarray, "3"] | None:
    """A dig pose at the toe of a pile as it is: x, y [m] and heading [rad].

    Args:
        pile: One pile.
        place: Which of the accessible points of the toe, 0 to 1 along it.
        turn: Heading over the normal into the pile [rad].
        near: Where to dig, as near as the toe comes to it [m]; then `place` does not count.

    Returns:
        The pose; None if there is nothing left to dig.
    """
    try:
        toe = toe_contour(pile)
    except InputError:
        return None
    candidates = np.flatnonzero(toe.accessible)
    if candidates.size == 0:
        return None
    if near is None:
        at = candidates[min(int(place * candidates.size), candidates.size - 1)]
    else:
        at = candidates[np.square(toe.points[candidates] - near).sum(axis=1).argmin()]
    return np.array([*toe.points[at], toe.heading[at] + turn], np.float32)


@functools.cache
def grid_shape() -> tuple[int, int]:
    """The smallest grid that holds each of the seed piles [cells]."""
    shapes = [seed_pile(kind, slope=slope, noise=0.0).height.shape for kind, slope in SEED_PILES]
    nx, ny = np.max(shapes, axis=0)
    return int(nx), int(ny)


def grid_origin() -> Float[Array, "2"]:
    """Centre of the first cell of the grid; that of the grid is the world origin [m]."""
    return jnp.asarray(-0.5 * CELL_SIZE * (np.array(grid_shape(), np.float32) - 1.0))


def _on_grid(pile: Pile, shape: tuple[int, int]) -> Pile:
    """A seed pile with level ground added on all sides; its centre stays the world origin."""
    # Seed piles have an odd number of cells a side, so the rim is the same on both sides.
    rim = [(n - old) // 2 for n, old in zip(shape, pile.height.shape, strict=True)]
    return dataclasses.replace(
        pile,
        height=jnp.pad(pile.height, [(r, r) for r in rim]),
        origin=jnp.asarray(pile.origin) - CELL_SIZE * jnp.asarray(rim, pile.height.dtype),
    )


@functools.cache
def compiled_relax(repose_angle: float) -> Callable[[Pile], Pile]:
    """`relax` for an angle of repose [rad], compiled."""
    # One pile at a time, since `relax` stops as soon as the pile stands.
    return jax.jit(functools.partial(relax, repose_angle=repose_angle))
