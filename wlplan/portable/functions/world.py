"""A world: what one loading yields and costs, and what it leaves of the pile."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array

from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import (
    ACTION,
    ORIGIN,
    PERFORMANCE,
    Asked,
    actions,
    for_each,
    over_grid,
    poses,
)
from wlplan.types import Pile, Pose, action_from


def portable(asked: Asked) -> PortableFunction:
    """The world, over piles with the grid of the pile."""
    pile, world = asked.pile, asked.world
    inputs = (
        over_grid("height", "surface of pile and terrain", pile),
        over_grid("ground", "what cannot be moved, the floor under the pile", pile),
        ORIGIN,
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
    outputs = (over_grid("height_after", "surface after the loading", pile), *PERFORMANCE)

    def function(
        height: Array, ground: Array, origin: Array, pose: Array, action: Array
    ) -> tuple[Array, ...]:
        before = Pile(height, pile.cell_size, origin, ground)
        after, done = world(before, Pose(*(pose[k] for k in range(3))), action_from(action))
        return after.height, done.mass, done.time, done.work

    where = poses(asked)

    return PortableFunction(
        name="world",
        meaning="what one loading yields and costs, and what it leaves of the pile",
        function=function,
        inputs=inputs,
        outputs=outputs,
        cases=(
            for_each(asked, pile.height),
            for_each(asked, pile.floor),
            for_each(asked, pile.origin),
            np.stack([where.x, where.y, where.heading], axis=1),
            actions(asked),
        ),
        origin={**asked.origin, "cell_size": pile.cell_size, "sha256": checksum(world)},
    )
