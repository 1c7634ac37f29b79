"""Time and work of the transport, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.constants import DUMP_TIME, GRAVITY
from wlplan.planning.driving import Way, room_of
from wlplan.planning.loading import Transport
from wlplan.planning.transport import SHIFT_TIME, transport
from wlplan.planning.yard import yard_of
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Pile, Pose

PILE = Pile(np.zeros((200, 200), np.float32), 0.1, (-15.0, -10.0))
YARD = yard_of(PILE, WA320)
POSE = Pose(*(jnp.float32(v) for v in (0.0, 0.0, 0.0)))


@jax.jit
def _drive(mass: jax.Array, receiver: Receiver) -> tuple[Transport, Way]:
    room = room_of(YARD, PILE)
    return transport(PILE, POSE, mass, Site(receiver=receiver), room)


def drive(mass: float, x: float = -9.0) -> tuple[Transport, Way]:
    receiver = Receiver(*(jnp.float32(v) for v in (x, 4.0, 1.3)))
    found: tuple[Transport, Way] = _drive(jnp.float32(mass), receiver)
    return found


def test_time_and_work_by_hand() -> None:
    carried, way = drive(3.0)
    length = float(way.length)
    # The best ways are blended: a little longer than the best of them.
    driven = 0.5 * WA320.travel_speed * (float(carried.time) - 4.0 * SHIFT_TIME - DUMP_TIME)
    assert length - 1e-3 <= driven <= length + 0.3
    laden, empty = WA320.mass + 3000.0, WA320.mass
    rolling = WA320.rolling_resistance * GRAVITY * driven * (laden + empty)
    starts = WA320.travel_speed**2 * (laden + empty)
    assert float(carried.work) == pytest.approx((rolling + starts) / 1e3, rel=1e-4)
    assert float(carried.touching) < 0.02


def test_further_and_heavier_costs_more() -> None:
    near, far = drive(3.0)[0], drive(3.0, x=-14.0)[0]
    assert far.time > near.time
    assert far.work > near.work
    light, heavy = drive(1.0)[0], drive(4.0)[0]
    assert heavy.time == light.time
    assert heavy.work > light.work
