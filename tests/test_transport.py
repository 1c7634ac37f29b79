"""The V-turn: a closed form, symmetries, monotony, gradients."""

import math
from collections.abc import Iterable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike
from laws import assert_gradient

from wlplan.constants import GRAVITY
from wlplan.planning.transport import (
    DUMP_TIME,
    SHIFT_TIME,
    transport,
    v_turn_length,
)
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.receiver import Receiver, default_receiver
from wlplan.site.site import Site
from wlplan.types import Pile, Pose

Place = tuple[float, float, float]  # x [m], y [m], heading [rad]
Kind = TypeVar("Kind", Pose, Receiver)

# The follow-up's receiver for a pile whose toe is at the origin.
FOLLOW_UP = (-12.0, -3.0, math.radians(-30.0))
HEAD_ON = (0.0, 0.0, 0.0)


def of(cls: type[Kind], values: Iterable[ArrayLike]) -> Kind:
    return cls(*(jnp.asarray(v, jnp.result_type(float)) for v in values))


@jax.jit
def length_of(pose: Place, receiver: Place) -> jax.Array:
    return v_turn_length(of(Pose, pose), of(Receiver, receiver), machine=WA320)


@jax.jit
@jax.grad
def gradient_of_length(places: jax.Array) -> jax.Array:
    return v_turn_length(of(Pose, places[:3]), of(Receiver, places[3:]), machine=WA320)


def length(pose: Place, receiver: Place) -> float:
    return float(length_of(tuple(map(float, pose)), tuple(map(float, receiver))))


def drive(
    pose: Place, receiver: Place, mass: float, machine: WheelLoader = WA320
) -> tuple[float, float]:
    site = Site(machine=machine, receiver=of(Receiver, receiver))
    way = transport(of(Pose, pose), jnp.asarray(mass), site)
    return float(way.time), float(way.work)


def moved(place: Place, angle: float, dx: float, dy: float) -> Place:
    x, y, heading = place
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y + dx, s * x + c * y + dy, heading + angle


def cases(count: int = 12) -> Iterator[tuple[Place, Place]]:
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield (
            tuple(rng.uniform(-1, 1, 3) * [10, 10, math.pi]),
            tuple(rng.uniform(-1, 1, 3) * [20, 20, math.pi]),
        )


def test_the_follow_ups_case_is_close_to_the_straight_v() -> None:
    """Straight back, then straight ahead along the receiver's heading: two legs that meet."""
    x, y, heading = FOLLOW_UP
    forward = y / math.sin(heading)  # from y = 0 along the receiver's heading
    backward = -WA320.approach_distance - (x - forward * math.cos(heading))
    assert backward == pytest.approx(12.2, abs=0.05)
    assert forward == pytest.approx(6.0)
    # The turn at the meeting point is cut by an arc, so the way is a little shorter or longer.
    assert length(HEAD_ON, FOLLOW_UP) == pytest.approx(backward + forward, rel=0.25)


def test_straight_behind_it_is_there_and_back() -> None:
    """A receiver that faces the pile from behind: reverse past it, then forward a leg."""
    distance = 30.0
    receiver = (-WA320.approach_distance - distance, 0.0, 0.0)
    # At least the way itself and the shortest forward leg, and no more than a wide turn over that.
    way = length(HEAD_ON, receiver)
    assert distance <= way <= distance + 2 * math.pi * WA320.turning_radius


def test_time_and_work_by_hand() -> None:
    way = length(HEAD_ON, FOLLOW_UP)
    time, work = drive(HEAD_ON, FOLLOW_UP, 3.0)
    assert time == pytest.approx(2 * way / WA320.travel_speed + 4 * SHIFT_TIME + DUMP_TIME)
    laden, empty = WA320.mass + 3000.0, WA320.mass
    rolling = WA320.rolling_resistance * GRAVITY * way * (laden + empty)
    starts = WA320.travel_speed**2 * (laden + empty)
    assert work == pytest.approx((rolling + starts) / 1e3, rel=1e-5)


@pytest.mark.parametrize("angle", [0.3, 2.0, -2.9])
def test_it_does_not_depend_on_the_frame(angle: float) -> None:
    for pose, receiver in cases():
        turned = (moved(place, angle, 3.0, -7.0) for place in (pose, receiver))
        assert length(*turned) == pytest.approx(length(pose, receiver), abs=2e-4)


def test_left_and_right_are_alike() -> None:
    for pose, receiver in cases():
        mirrored = ((x, -y, -heading) for x, y, heading in (pose, receiver))
        assert length(*mirrored) == pytest.approx(length(pose, receiver), abs=2e-4)


def test_a_turn_more_or_less_is_the_same_heading() -> None:
    (x, y, heading), receiver = (1.0, 2.0, 0.4), FOLLOW_UP
    turned = length((x, y, heading + 2 * math.pi), receiver)
    assert turned == pytest.approx(length((x, y, heading), receiver), abs=2e-4)


def test_further_and_heavier_costs_more() -> None:
    ways = [drive(HEAD_ON, (-d, -3.0, FOLLOW_UP[2]), 3.0) for d in (10, 14, 20, 30, 60)]
    assert np.all(np.diff(ways, axis=0) > 0.0)
    (t0, w0), (t1, w1) = (drive(HEAD_ON, FOLLOW_UP, m) for m in (1.0, 4.0))
    assert t1 == t0
    assert w1 > w0


def test_it_is_never_shorter_than_the_straight_line() -> None:
    for pose, receiver in cases(40):
        start = np.array(pose[:2]) - WA320.approach_distance * np.array(
            [math.cos(pose[2]), math.sin(pose[2])]
        )
        straight = math.hypot(*(np.array(receiver[:2]) - start))
        # The blend of the candidates is a little below the least of them.
        assert length(pose, receiver) > straight - 0.3 * math.log(42) - 1e-3


def test_gradient_against_finite_differences() -> None:
    with jax.enable_x64(True):

        def one(p: jax.Array) -> jax.Array:
            way = transport(of(Pose, p[:3]), p[6], Site(receiver=of(Receiver, p[3:6])))
            return way.time + way.work / 10.0

        places = [[*pose, *receiver, 3.0] for pose, receiver in (*cases(4), (HEAD_ON, FOLLOW_UP))]
        assert_gradient(lambda p: jax.vmap(one)(p).sum(), jnp.asarray(np.array(places)))


@pytest.mark.parametrize(
    "receiver",
    [
        (0.0, 0.0, 0.0),  # at the dig location
        (-5.0, 0.0, 0.0),  # where the loading ends
        (-8.3, 0.0, 0.0),  # on the way back
        (-5.0 - 9.0, 0.0, math.pi),  # at a turning point, facing away
        (-5.0 - 6.0, 0.0, 0.0),  # at another, in line
        (40.0, 0.0, math.pi),  # behind the pile
    ],
)
def test_gradient_is_finite_at_special_places(receiver: Place) -> None:
    gradient = gradient_of_length(jnp.asarray((*HEAD_ON, *receiver), jnp.float32))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() < 100.0


def test_the_default_receiver_stands_where_the_follow_up_has_it() -> None:
    height = jnp.zeros((80, 60)).at[30:70, 20:41].set(1.0)
    receiver = default_receiver(Pile(height, 0.1, (-2.0, 5.0)))
    # The toe at x = -2 + 3.0; the middle of rows 20 to 40 at y = 5 + 3.0.
    np.testing.assert_allclose(
        [receiver.x, receiver.y, receiver.heading],
        [1.0 - 12.0, 8.0 - 3.0, math.radians(-30.0)],
        rtol=1e-5,
    )


def test_the_default_receiver_of_a_pile_on_a_slope_and_of_no_pile() -> None:
    ground = jnp.broadcast_to(jnp.linspace(0.0, 2.0, 80)[:, None], (80, 60))
    height = ground.at[30:70, 20:41].add(1.0)
    on_slope = default_receiver(Pile(height, 0.1, (-2.0, 5.0), ground=ground))
    assert on_slope.x == pytest.approx(-11.0, abs=1e-5)
    nothing = default_receiver(Pile(jnp.zeros((80, 60)), 0.1))
    assert np.isfinite([nothing.x, nothing.y, nothing.heading]).all()
