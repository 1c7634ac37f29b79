"""How the loadings of an episode follow each other: where it digs, and by which actions."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Largest deviation of the heading from the normal of the toe [rad]. Paper, section 6.2.
_TURN = math.radians(10.0)


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What the loadings of an episode have in common; by default the paper's, section 6.2.

    Attributes:
        stream: What its random numbers are for, part of their key.
        stay: Part of the loadings that stay near the one before; the others are anywhere along the
            toe.
        near: How near these stay, the standard deviation of either coordinate [m].
        repeat: Part of the loadings whose action is similar to that of the last slow filling.
        similar: How similar, the standard deviation of each parameter over its range.
        turn: Largest deviation of the heading from the normal of the toe [rad].
        past: How far before or behind the toe a loading begins, at most [m].
    """

    stream: int
    stay: float = 0.0
    near: float = 0.5
    repeat: float = 0.0
    similar: float = 0.1
    turn: float = _TURN
    past: float = 0.0

    def draw(self, seed: int, episode: int, length: int) -> Draws:
        """What is random in an episode besides what it has in every protocol."""
        key = np.random.SeedSequence(seed, spawn_key=(self.stream, episode))
        random = np.random.default_rng(key)
        shift, variation = np.full((length, 2), np.nan), np.full((length, 4), np.nan)
        past = np.zeros(length)
        if self.stay:
            stays = random.random(length) < self.stay
            stays[0] = False
            shift = np.where(stays[:, None], random.normal(0.0, self.near, (length, 2)), np.nan)
        if self.repeat:
            repeats = random.random(length) < self.repeat
            drawn = random.normal(0.0, self.similar, (length, 4))
            variation = np.where(repeats[:, None], drawn, np.nan)
        if self.past:
            past = random.uniform(-self.past, self.past, length)
        return Draws(shift, variation, past)


class Draws(NamedTuple):
    """What is random in an episode: of every loading, one row."""

    shift: Float[
        np.ndarray, "n 2"
    ]  # how far from the one before it is looked for [m]; NaN: anywhere
    variation: Float[
        np.ndarray, "n 4"
    ]  # of the action from the last slow one's; NaN: in everything
    past: Float[np.ndarray, " n"]  # along the heading, from the toe on [m]


# Numbers 0 and 1 are the streams of what an episode has in every protocol.
PROTOCOLS = {
    "paper": Protocol(stream=4),
    "corridor": Protocol(stream=2, stay=0.85),
    "slow": Protocol(stream=3, repeat=0.8),
    "past-toe": Protocol(stream=5, stay=0.85, turn=math.radians(45.0), past=1.0),
}
"""How an episode continues. "paper": anywhere along the toe with any action, as in section 6.2.
"corridor": mostly near where it dug before, as plans do: so corridors come about, and what stands
between them. "slow": anywhere, mostly with an action like that of the last slow filling: so there
are far more loadings that stall, or nearly do, than the paper's few in a hundred. "past-toe": near
where it dug before, but aslant, and begun before or behind the toe: so loadings meet ridges and
what others left, and show what changes when a pose is moved straight ahead."""
