"""From the pile to the load receiver and back: the way, the time and the work that it takes.

The loader goes to the receiver by the way of `wlplan.planning.way`, dumps, and comes back the same
way.
"""

from __future__ import annotations

from jaxtyping import Array, Float

from wlplan.constants import DUMP_TIME, GRAVITY, J_PER_KJ, KG_PER_TONNE
from wlplan.planning.driving import Room, Way
from wlplan.planning.lane import lane_touching
from wlplan.planning.loading import Transport
from wlplan.planning.search import Cusps
from wlplan.planning.way import way_to
from wlplan.site.site import Site
from wlplan.types import Pile, Pose

# Each change between forward and reverse [s]. Estimate.
SHIFT_TIME = 1.0


def transport(
    pile: Pile,
    pose: Pose,
    mass: Float[Array, ""],
    site: Site,
    room: Room,
    *,
    cusps: Cusps | None = None,
    thorough: bool = True,
) -> tuple[Transport, Way]:
    """From the end of a loading to the start of the next approach.

    Args:
        pile: The pile before the loading.
        pose: Dig pose; the loading ends the machine's `approach_distance` behind it.
        mass: Load [tonne].
        site: Machine, and the receiver that the load goes to.
        room: To drive around the pile.
        cusps: As of `way_to`.
        thorough: Likewise.

    Returns:
        Time, work and what is touched, smooth in pose and receiver; and the way that is driven,
        whose length is that of the time and the work to a centimetre or so, see `way_to`.
    """
    machine = site.machine
    receiver = site.placed_receiver
    length, touching, way = way_to(pose, receiver, room, machine, cusps=cusps, thorough=thorough)
    lane = lane_touching(pose, receiver, pile, room.yard, machine)
    speed = machine.travel_speed
    # There and back; two changes of direction each way.
    time = 2.0 * length / speed + 4.0 * SHIFT_TIME + DUMP_TIME
    load = mass * KG_PER_TONNE
    rolling = machine.rolling_resistance * GRAVITY * length * (2.0 * machine.mass + load)
    # Two starts from rest each way, laden on the way there.
    starts = 0.5 * speed**2 * 2.0 * (2.0 * machine.mass + load)
    return Transport(time, (rolling + starts) / J_PER_KJ, touching + lane), way
