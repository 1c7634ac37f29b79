"""Soils and machines at the ends of what is let pass: what the simulator makes of them is sound."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.constants import ACTION_HIGH, GRAVITY
from wlplan.engines.limits import MAX_FILL_TIME, MAX_PENETRATION, RETREAT_SPEED
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.parameters import ranges_of
from wlplan.site.presets import check_machine, check_soil
from wlplan.site.soil import GRAVEL, SOILS, Soil
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Performance, Pile, Pose, action_from

CORNERS = 25
# Longest after the filling until the bucket has tilted [s], see `wlplan.engines.simulator.cycle`.
SETTLING = 3.0
# Two that lift or tilt by force, one that does nothing, ones that only lift or only tilt.
ACTIONS = np.array(
    [[0.3, 2.5, 0.3, 2.5], [0.68, 4.51, 0.17, 4.46], [0, 0, 0, 0], [0, 5, 0.7, 0], [0.7, 0, 0, 5]]
)
assert (np.array(ACTION_HIGH) >= ACTIONS).all()

# A loader that people walk beside, and one for a mine, from brochures of such classes, rounded.
COMPACT = dataclasses.replace(
    WA320,
    **{"mass": 2_000.0, "wheel_power": 12_000.0, "length": 4.0, "turning_radius": 2.8},
    **{"bucket_width": 1.1, "bucket_depth": 0.5, "bucket_heaped": 0.3, "side_height": 0.4},
    **{"bucket_mass": 100.0, "boom_mass": 80.0, "pivot_height": 1.2, "boom_length": 1.5},
    **{"tip_radius": 0.7, "boom_low": math.radians(-35.0), "boom_force": 50_000.0},
    **{"boom_force_nominal": 40_000.0, "boom_lever": 0.25, "tilt_moment": 10_000.0},
    **{"speed_gain": 1.5e4},
)
MINING = dataclasses.replace(
    WA320,
    **{"mass": 100_000.0, "wheel_power": 500_000.0, "length": 12.0, "turning_radius": 9.5},
    **{"bucket_width": 4.6, "bucket_depth": 2.2, "bucket_heaped": 11.0, "side_height": 1.5},
    **{"bucket_mass": 9_000.0, "boom_mass": 8_000.0, "pivot_height": 3.2, "boom_length": 4.4},
    **{"tip_radius": 2.2, "boom_low": math.radians(-34.0), "boom_force": 3e6},
    **{"boom_force_nominal": 2.5e6, "boom_lever": 0.8, "tilt_moment": 1.6e6},
)


def si(kind: type, name: str, end: str) -> float:
    """An end of the range of a field, in SI units and radians."""
    allowed = ranges_of(kind)[name]
    value: float = getattr(allowed, end)
    return math.radians(value) if allowed.is_angular else value


def corner(kind: Any, check: Any, base: Any, random: np.random.Generator) -> Any:
    """Each field at an end of its range or as in the preset, such that it all is let pass."""
    while True:
        choice = random.integers(3, size=len(ranges_of(kind)))
        values = {
            name: getattr(base, name) if c == 2 else si(kind, name, ("low", "high")[c])
            for name, c in zip(ranges_of(kind), choice, strict=True)
        }
        try:
            check(made := kind(**values))
        except InputError:
            continue
        return made


def soil_with(**ends: str) -> Soil:
    """Gravel, with some fields at an end of their range."""
    return dataclasses.replace(GRAVEL, **{k: si(Soil, k, v) for k, v in ends.items()})


NAMED: dict[str, tuple[Soil, WheelLoader]] = {
    "gravel": (GRAVEL, WA320),
    **{name: (soil, WA320) for name, soil in SOILS.items() if name != "gravel"},
    "compact": (GRAVEL, COMPACT),
    "mining": (GRAVEL, MINING),
    "light": (soil_with(density="low"), WA320),
    "heavy": (soil_with(density="high"), MINING),
    "runs like water": (soil_with(friction="low", steel_friction="low", slide_rate="high"), WA320),
    "steep": (soil_with(friction="high"), WA320),
    "cohesive": (soil_with(cohesion="high", adhesion="high"), WA320),
    "hard": (soil_with(edge_resistance="high", intrusion_stiffness="high"), WA320),
    # A bucket that is thrown to the end of the local map: what it pushed there was once lost.
    "far reaching": (
        dataclasses.replace(
            soil_with(friction="low", steel_friction="low", slide_rate="high", density="low"),
            content_push=0.0,
            content_carry=0.0,
            edge_resistance=0.0,
        ),
        dataclasses.replace(
            MINING,
            **{"travel_speed": 5.0, "traction": 0.3, "rolling_resistance": 0.0},
            **{"approach_distance": 50.0, "boom_length": 10.0, "tip_radius": 5.0},
            **{"boom_low": 0.0, "boom_carry": math.radians(80.0), "boom_high": math.radians(80.0)},
            **{"boom_speed": math.pi, "bucket_depth": 0.2, "pivot_height": 0.3},
            **{"boom_force": 1e7, "boom_lever": 0.05, "boom_force_nominal": 1e4},
            **{"tilt_end": math.radians(5.0), "tilt_moment": 1e7},
        ),
    ),
}


def cases() -> dict[str, tuple[Soil, WheelLoader]]:
    """The named ones, and random corners."""
    random = np.random.default_rng(0)
    return NAMED | {
        f"corner {n}": (
            corner(Soil, check_soil, GRAVEL, random),
            corner(WheelLoader, check_machine, WA320, random),
        )
        for n in range(CORNERS)
    }


CASES = cases()


@pytest.fixture(scope="module")
def loads() -> tuple[Pile, Pose, Any]:
    """A pile, and poses and actions, leaves [N]."""
    pile = seed_pile("conical", slope=0.5, height=2.0)
    at = edge_poses(toe_contour(pile), 3)
    poses = [np.repeat(getattr(at, name), len(ACTIONS)) for name in ("x", "y", "heading")]
    actions = action_from(jnp.asarray(np.tile(ACTIONS, (3, 1)), jnp.float32))
    return pile, Pose(*(jnp.asarray(v, jnp.float32) for v in poses)), actions


def longest(machine: WheelLoader, load: float) -> float:
    """No cycle takes longer [s]: the ways in closed form, and the limits of the filling."""
    speed, most = machine.travel_speed, machine.boom_high - machine.boom_low
    back = machine.approach_distance + MAX_PENETRATION + SETTLING * speed
    accelerating = 0.5 * (machine.mass + load) * speed**2 / machine.wheel_power
    boom = max(most, machine.boom_carry - machine.boom_low) / (RETREAT_SPEED * machine.boom_speed)
    filling = MAX_FILL_TIME + SETTLING + 0.1
    return (
        machine.approach_distance / speed + filling + max(back / speed + accelerating / 3.0, boom)
    )


def hardest(machine: WheelLoader, load: float) -> float:
    """No cycle takes more work [J]: what wheels, boom and bucket can give, and the ways."""
    total, speed = machine.mass + load, machine.travel_speed
    way = 2.0 * machine.approach_distance + MAX_PENETRATION + SETTLING * speed
    lift = 2.0 * machine.boom_length * GRAVITY
    return (
        machine.wheel_power * (MAX_FILL_TIME + SETTLING)
        + 0.5 * total * speed**2
        + machine.rolling_resistance * total * GRAVITY * way
        + machine.boom_force * machine.boom_lever * (machine.boom_high - machine.boom_low)
        + machine.tilt_moment * machine.tilt_end
        + (machine.bucket_mass + machine.boom_mass + load) * lift
    )


def check_loads(
    soil: Soil, machine: WheelLoader, before: Pile, heights: np.ndarray, got: Performance
) -> None:
    """The laws of all loads: finite, no soil from nowhere, no more time and work than can be.

    Args:
        soil: That was dug.
        machine: That dug it.
        before: Pile before each of the loads.
        heights: After each [m].
        got: Performance, leaves [N].
    """
    mass, time, work = (np.asarray(getattr(got, q), np.float64) for q in ("mass", "time", "work"))
    assert all(np.isfinite(values).all() for values in (heights, mass, time, work))
    assert (mass >= 0.0).all()
    was = np.asarray(before.height, np.float64).sum()
    area, density = before.cell_size**2, soil.density / 1e3
    removed = (was - heights.astype(np.float64).sum((1, 2))) * area * density
    # In float32 a load of next to nothing is off by the rounding of what was moved: 2 m^3 stand
    # for that.
    bound = 1e-5 * np.maximum(mass, 2.0 * density)
    assert (np.abs(removed - mass) <= bound).all(), np.abs(removed - mass).max()
    assert heights.min() >= -1e-6
    most = float(mass.max()) * 1e3
    assert time.min() > 0.0
    assert time.max() <= longest(machine, most) * (1.0 + 1e-5)
    assert work.min() >= 0.0
    assert work.max() * 1e3 <= hardest(machine, most) * (1.0 + 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_is_let_pass_is_played_soundly(name: str, loads: tuple[Pile, Pose, Any]) -> None:
    soil, machine = CASES[name]
    check_soil(soil)
    check_machine(machine)
    pile, poses, actions = loads
    play = jax.jit(jax.vmap(Simulator(machine=machine, soil=soil), in_axes=(None, 0, 0)))
    after, got = play(pile, poses, actions)
    check_loads(soil, machine, pile, np.asarray(after.height), got)


def test_the_laws_can_fail(loads: tuple[Pile, Pose, Any]) -> None:
    pile, _, _ = loads
    height = np.asarray(pile.height)
    nothing = np.stack([height])

    def check(mass: float = 0.0, time: float = 10.0, work: float = 300.0) -> None:
        got = Performance(np.array([mass]), np.array([time]), np.array([work]))
        check_loads(GRAVEL, WA320, pile, nothing, got)

    check()
    wrong: tuple[dict[str, float], ...] = (
        {"mass": 1e-3},
        {"mass": -1e-9},
        {"time": 60.0},
        {"time": math.nan},
        {"work": 12_000.0},
    )
    for change in wrong:
        with pytest.raises(AssertionError):
            check(**change)


def test_a_machine_that_cannot_hold_or_reach_its_speed_is_refused() -> None:
    weak = dataclasses.replace(WA320, wheel_power=5_000.0, approach_distance=50.0)
    hasty = dataclasses.replace(WA320, travel_speed=5.0, approach_distance=1.0)
    for machine, words in (
        (weak, "5000 W, too little for 15200 kg to hold a travel_speed of 2.22 m/s: give"),
        (hasty, "to reach a travel_speed of 5 m/s within 1 m: give at least 6.33e[+]05 W"),
    ):
        with pytest.raises(InputError, match=words):
            check_machine(machine)
