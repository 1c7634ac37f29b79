"""The next load from a pile: what a planner would do next, as one function."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array

from wlplan.planning.placement import beside
from wlplan.planning.replanning import next_load
from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import ORIGIN, PERFORMANCE, Asked, for_each, over_grid
from wlplan.site.receiver import Receiver
from wlplan.types import Pile, action_vector


def portable(asked: Asked) -> PortableFunction:
    """The next load, from piles with the grid of the pile."""
    pile, world = asked.pile, asked.world
    place = "x [m], y [m] and heading [rad], counter-clockwise from +x"
    inputs = (
        over_grid("height", "surface of pile and terrain", pile),
        over_grid("ground", "what cannot be moved, the floor under the pile and walls", pile),
        over_grid("valid", "1 where the scan saw the cell, else 0", pile, "1"),
        ORIGIN,
        Port(
            "receiver",
            f"of the middle of the loader as it dumps: {place}",
            "m, m, rad",
            "world",
            (3,),
        ),
    )
    outputs = (
        Port("pose", f"of the dig location: {place}", "m, m, rad", "world", (3,)),
        Port("action", "parameters of the bucket-filling controller", "1", shape=(4,)),
        *PERFORMANCE,
        Port("transport_time", "to the receiver and back, dumping included", "s"),
        Port("transport_work", "to the receiver and back", "kJ"),
        Port("cost", "of the load for the objective efficiency; infinite: nothing to dig", "1"),
    )

    def function(
        height: Array, ground: Array, valid: Array, origin: Array, receiver: Array
    ) -> tuple[Array, ...]:
        before = Pile(height, pile.cell_size, origin, ground, valid > 0.5)
        site = asked.site.replace(receiver=Receiver(*(receiver[k] for k in range(3))))
        load = next_load(world, before, site=site)
        pose = jax.numpy.stack([load.pose.x, load.pose.y, load.pose.heading])
        done, carried = load.performance, load.transport
        return (
            *(pose, action_vector(load.action), done.mass, done.time, done.work),
            *(carried.time, carried.work, load.cost),
        )

    placed = beside(asked.site, pile, asked.contour).placed_receiver
    at = np.array([float(leaf) for leaf in (placed.x, placed.y, placed.heading)], np.float32)
    seen = np.ones(pile.height.shape) if pile.valid is None else np.asarray(pile.valid)

    return PortableFunction(
        name="next-load",
        meaning="the cheapest next load from a pile: where to dig, how, and what it comes to",
        function=function,
        inputs=inputs,
        outputs=outputs,
        cases=tuple(
            for_each(asked, value) for value in (pile.height, pile.floor, seen, pile.origin, at)
        ),
        origin={**asked.origin, "cell_size": pile.cell_size, "sha256": checksum(world)},
    )
