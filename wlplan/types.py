"""The pytrees that every stage shares, and the one signature that joins them.

Frames: the world frame has x east, y north, z up. The local frame of a pose has e_x along the
heading and e_y to its left. Everything is SI except `Performance`, which is in tonne and kJ as in
the paper. Array leaves are batched by `jax.vmap`; nothing in here does arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int

# JAX rebuilds pytrees with tracers, shapes or None inside, so these classes opt out of runtime
# shape checking; the functions that take them are checked.
#
# Users write arrays as numpy, lists or Python numbers: type checkers see constructors that take
# all of them, and `_as_arrays` makes arrays of what a pytree would take apart.


def _as_arrays(node: Any, *names: str) -> None:
    """Turns numpy arrays, lists and tuples among fields into arrays; leaves all else untouched."""
    for name in names:
        value = getattr(node, name)
        if isinstance(value, np.ndarray):
            # `jnp.asarray` would compile for each shape.
            object.__setattr__(node, name, jax.device_put(value))
        elif isinstance(value, list | tuple):
            object.__setattr__(node, name, jnp.asarray(value))


@no_type_check
class Pile(struct.PyTreeNode):
    """Heights of a pile and the terrain around it on a square grid, world frame.

    Cell `[i, j]` is centred at x = origin[0] + i * cell_size, y = origin[1] + j * cell_size.
    """

    height: Float[Array, "*batch nx ny"]  # surface [m]
    cell_size: float = struct.field(pytree_node=False)  # grid spacing [m]
    origin: Float[Array, "*batch 2"] = (0.0, 0.0)  # type: ignore[assignment]  # cell [0, 0] [m]
    ground: Float[Array, "*batch nx ny"] | None = None  # what cannot be moved [m]; None: level 0
    valid: Bool[Array, "*batch nx ny"] | None = None  # cells the scan saw; None: all of them

    if TYPE_CHECKING:

        def __init__(
            self,
            height: ArrayLike | list[Any],
            cell_size: float,
            origin: ArrayLike | list[float] | tuple[float, float] = (0.0, 0.0),
            ground: ArrayLike | list[Any] | None = None,
            valid: ArrayLike | list[Any] | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        if isinstance(self.origin, tuple | list) and all(
            isinstance(value, int | float | np.number) for value in self.origin
        ):
            object.__setattr__(self, "origin", jnp.asarray(self.origin, dtype=float))
        _as_arrays(self, "height", "origin", "ground", "valid")

    @property
    def floor(self) -> Float[Array, "*batch nx ny"]:
        """What cannot be moved: floor under the pile [m]; level 0 where there is no ground map."""
        return jnp.zeros_like(self.height) if self.ground is None else self.ground


@no_type_check
class Pose(struct.PyTreeNode):
    """A dig location at the toe of the pile and the heading into the pile, world frame."""

    x: Float[Array, "*batch"]  # [m]
    y: Float[Array, "*batch"]  # [m]
    heading: Float[Array, "*batch"]  # [rad], counter-clockwise from +x

    if TYPE_CHECKING:

        def __init__(
            self,
            x: ArrayLike | list[Any],
            y: ArrayLike | list[Any],
            heading: ArrayLike | list[Any],
        ) -> None: ...

    def __post_init__(self) -> None:
        _as_arrays(self, "x", "y", "heading")


@no_type_check
class Action(struct.PyTreeNode):
    """Parameters of the automatic bucket-filling controller. Paper, section 5.2."""

    delta_bm: Float[Array, "*batch"]  # boom force threshold [1], 0..0.7
    k_bm: Float[Array, "*batch"]  # boom velocity gain [1], 0..5
    delta_bk: Float[Array, "*batch"]  # bucket force threshold [1], 0..0.7
    k_bk: Float[Array, "*batch"]  # bucket velocity gain [1], 0..5

    if TYPE_CHECKING:

        def __init__(
            self,
            delta_bm: ArrayLike | list[Any],
            k_bm: ArrayLike | list[Any],
            delta_bk: ArrayLike | list[Any],
            k_bk: ArrayLike | list[Any],
        ) -> None: ...

    def __post_init__(self) -> None:
        _as_arrays(self, "delta_bm", "k_bm", "delta_bk", "k_bk")


def action_vector(action: Action) -> Float[Array, "*batch 4"]:
    """[delta_bm, k_bm, delta_bk, k_bk] along a last axis."""
    return jnp.stack([action.delta_bm, action.k_bm, action.delta_bk, action.k_bk], axis=-1)


def action_from(vector: Float[Array, "*batch 4"]) -> Action:
    """The inverse of `action_vector`."""
    return Action(*(vector[..., k] for k in range(4)))


@no_type_check
class Performance(struct.PyTreeNode):
    """What one loading yields and costs. Paper, section 6.1."""

    mass: Float[Array, "*batch"]  # [tonne]
    time: Float[Array, "*batch"]  # [s]
    work: Float[Array, "*batch"]  # [kJ]

    if TYPE_CHECKING:

        def __init__(
            self,
            mass: ArrayLike | list[Any],
            time: ArrayLike | list[Any],
            work: ArrayLike | list[Any],
        ) -> None: ...

    def __post_init__(self) -> None:
        _as_arrays(self, "mass", "time", "work")


@no_type_check
class Characteristics(struct.PyTreeNode):
    """The four local pile characteristics of the low-dimensional model. Paper, section 4.3."""

    slope: Float[Array, "*batch"]  # theta [rad]
    incidence: Float[Array, "*batch"]  # alpha [rad], 0 head-on
    curvature_x: Float[Array, "*batch"]  # kappa_x [1/m], convex positive
    curvature_y: Float[Array, "*batch"]  # kappa_y [1/m], convex positive

    if TYPE_CHECKING:

        def __init__(
            self,
            slope: ArrayLike,
            incidence: ArrayLike,
            curvature_x: ArrayLike,
            curvature_y: ArrayLike,
        ) -> None: ...


@no_type_check
class LocalHeightmap(struct.PyTreeNode):
    """Heights in the local frame of a pose, relative to the first point of the centre line.

    Cell `[i, j]` lies i * cell_size - displacement along the heading and
    (j - (n - 1) / 2) * cell_size to its left.
    """

    height: Float[Array, "*batch n n"]  # [m]
    cell_size: float = struct.field(pytree_node=False)  # [m]
    displacement: float = struct.field(pytree_node=False)  # delta, towards the approach [m]

    if TYPE_CHECKING:

        def __init__(self, height: ArrayLike, cell_size: float, displacement: float) -> None: ...


@no_type_check
class SolveReport(struct.PyTreeNode):
    """How the solvers of a loading ended; every leaf is a scalar, or has the loadings as its axis.

    A world that solves for the pile after a loading reports this by `solve(pile, pose, action) ->
    (pile_after, performance, report)`, the first two as by calling it.
    """

    rounds: Int[Array, "*n"]  # that the automaton made
    settled: Bool[Array, "*n"]  # whether it came to rest; False: it ran out of rounds
    steepest_slope: Float[Array, "*n"]  # left between cells that can slide [rad]
    missing: Float[Array, "*n"]  # volume that was to leave the pile and has not [m^3]


@no_type_check
class LoadingPlan(struct.PyTreeNode):
    """N loadings in order; every leaf has the leading axis N."""

    pose: Pose
    action: Action
    # The truck that each load goes to, counted from 0; -1: the load is not made. None: all loads
    # are made, and who follows the plan knows when a truck leaves.
    truck: Int[Array, "*batch"] | None = None


@no_type_check
class Rollout(struct.PyTreeNode):
    """The outcome of a plan."""

    performance: Performance  # per loading, leaves (N,)
    pile: Pile  # after the last loading


World = Callable[[Pile, Pose, Action], tuple[Pile, Performance]]
"""`world(pile, pose, action) -> (pile_after, performance)`: a simulator or a learned model.

The pile after has the same grid, ground and mask as the pile before.
"""

PyTree = Any
