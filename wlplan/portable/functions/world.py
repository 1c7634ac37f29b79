"""A world: what one loading yields and costs, and what it leaves of the pile."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array

from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import ACTION, PERFORMANCE, Asked, actions, poses
from wlplan.types import Pile, Pose, action_from


def portable(asked: Asked) -> PortableFunction:
    """The world, over piles with the grid of the pile."""
    pile, world = asked.pile, asked.world
    grid = pile.height.shape
    cell = (
        f"cell [i, j] is centred at x = origin[0] + i * {pile.cell_size:g} m, "
        f"y = origin[1] + j * {pile.cell_size:g} m"
    )
    inputs = (
        Port("height", f"surface of pile and terrain: {cell}", "m", "world", grid),
        Port("ground", "what cannot be moved: floor under the pile", "m", "world", grid),
        Port("origin", "x and y of the centre of cell [0, 0]", "m", "world", (2,)),
        Port(
            "pose",
            "x [m] and y [m] of the dig location at the toe, and the heading into the pile [rad], "
            "counter-clockwise from +x",
            "m, m, rad",
            "world",
            (3,),
        ),
        ACTION,
    )
    outputs = (Port("height_after", "surface after the loading", "m", "world", grid), *PERFORMANCE)

    def function(
        height: Array, ground: Array, origin: Array, pose: Array, action: Array
    ) -> tuple[Array, ...]:
        before = Pile(height, pile.cell_size, origin, ground)
        after, done = world(before, Pose(*(pose[k] for k in range(3))), action_from(action))
        return after.height, done.mass, done.time, done.work

    where = poses(asked)

    def each(values: Array) -> np.ndarray:
        one = np.asarray(values, np.float32)
        return np.repeat(one[None], asked.count, axis=0)

    return PortableFunction(
        name="world",
        meaning="what one loading yields and costs, and what it leaves of the pile",
        function=function,
        inputs=inputs,
        outputs=outputs,
        cases=(
            each(pile.height),
            each(pile.floor),
            each(pile.origin),
            np.stack([where.x, where.y, where.heading], axis=1),
            actions(asked),
        ),
        origin={**asked.origin, "cell_size": pile.cell_size, "sha256": checksum(world)},
    )
