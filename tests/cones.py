"""A cone with its toe, and worlds in closed form to plan on it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.terrain.excavation import excavate
from wlplan.terrain.toe import ToeContour
from wlplan.types import Action, Performance, Pile, Pose, action_vector

BEST_ACTION = np.array([0.3, 2.0, 0.5, 3.5])
SITE = Site(receiver=Receiver(jnp.float32(-12.5), jnp.float32(4.0), jnp.float32(1.3)))


def cone(dtype: DTypeLike = jnp.float32, radius: float = 5.0, cells: int = 161) -> Pile:
    x = 0.1 * np.arange(cells) - 8.0
    height = np.maximum(0.5 * (radius - np.hypot(x[:, None], x[None, :])), 0.0)
    return Pile(jnp.asarray(height, dtype), 0.1, (-8.0, -8.0))


def wide_cone() -> Pile:
    """The cone with ground all around that the scan saw."""
    return (
        cone(cells=401)
        .replace(origin=jnp.asarray([-20.0, -20.0]))
        .replace(height=jnp.roll(cone(cells=401).height, (120, 120), (0, 1)))
    )


def on_map(*cones: tuple[tuple[float, float], float]) -> Pile:
    """Cones of 30 degrees on one map of 26 x 16 m: middle and radius [m] of each."""
    x, y = np.meshgrid(0.1 * np.arange(260), 0.1 * np.arange(160), indexing="ij")
    height = np.zeros_like(x)
    for (cx, cy), radius in cones:
        height = np.maximum(height, 0.577 * (radius - np.hypot(x - cx, y - cy)))
    return Pile(jnp.asarray(height, jnp.float32), 0.1)


def circle(radius: float = 4.7, n: int = 290) -> ToeContour:
    """The toe of the cone where it rises by TOE_RISE."""
    angle = 2 * np.pi * np.arange(n) / n
    return ToeContour(
        points=radius * np.stack([np.cos(angle), np.sin(angle)], axis=1),
        heading=angle - np.pi,
        length=2 * np.pi * radius,
        closed=True,
        accessible=np.ones(n, bool),
    )


def fill(action: Action) -> jax.Array:
    """1 at the best action, and less with the distance from it."""
    found = action_vector(action)
    best, size = (jnp.asarray(v, found.dtype) for v in (BEST_ACTION, [0.7, 5.0, 0.7, 5.0]))
    part = (found - best) / size
    return 1.0 / (1.0 + 4.0 * (part**2).sum())


def bowl_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """The load falls with the distance of the action from the best one; digging is real."""
    mass = 3.0 * fill(action)
    after, volume = excavate(pile, pose, mass / 1.7, width=2.7)[:2]
    mass = 1.7 * volume
    return after, Performance(mass=mass, time=9.0 + mass, work=300.0 + 20.0 * mass)


def spoilt_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """In the east a load holds a little more, but spoils all loads after it.

    A corner of the map, where no pile is, remembers that. The best two loads are one in the west
    and then one in the east: 2.8 and 3.0 t.
    """
    east = jax.nn.sigmoid(4.0 * pose.x)
    spoilt = pile.height[0, 0] / 0.01
    mass = (2.8 + 0.2 * east) * fill(action) * (1.0 - 0.7 * spoilt)
    after = pile.replace(height=pile.height.at[0, 0].set(0.01 * jnp.maximum(spoilt, east)))
    return after, Performance(mass=mass, time=10.0 + 0.0 * mass, work=300.0 + 0.0 * mass)
