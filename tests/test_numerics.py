"""Laws of the numerical core on piles of every sort, as hypothesis draws them.

All examples of a law are one program: piles have the same size, a floor and a mask.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any

import any_piles
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from any_piles import CELL, Sort
from examples import examples
from hypothesis import given, settings
from laws import assert_volume_kept

import wlplan
from wlplan.planning.rollout import rollout
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import DEFAULT_SCHEDULE, settle, settle_dug, window_of
from wlplan.terrain.automaton.windows import paste
from wlplan.terrain.excavation import excavate
from wlplan.terrain.heightmap import add_local_change, sample_local
from wlplan.types import LoadingPlan, Pile, Pose

CELLS, WIDTH = 64, 2.7
EPS = float(np.finfo(np.float32).eps)

sorts = st.builds(
    Sort,
    st.sampled_from(any_piles.BASES),
    st.sampled_from(any_piles.FLOORS),
    st.sampled_from(any_piles.MASKS),
    st.sampled_from([1.0, 0.3, 0.02, 0.0]),
    st.integers(0, 99),
)
places = st.sampled_from(any_piles.PLACES)
seeds = st.integers(0, 999)


@functools.lru_cache(maxsize=512)
def pile_of(sort: Sort, dtype: type = np.float32) -> Pile:
    return any_piles.pile_of(sort, CELLS, dtype)


def pose_of(place: str, seed: int, dtype: type = np.float32) -> Pose:
    plan = any_piles.plan_of((place,), seed, CELLS, dtype)
    pose: Pose = jax.tree.map(lambda leaf: leaf[0], plan.pose)
    return pose


def change_of(seed: int, dtype: type = np.float32) -> jax.Array:
    """A change of a local map [m]: a hole, and beside it a heap of no more than was in it."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(52), np.arange(52), indexing="ij")
    i, j, k = random.uniform(10, 40, 3)
    hole = random.uniform(0.0, 0.5) * np.exp(-(((x - i) / 8) ** 2) - ((y - j) / 8) ** 2)
    heap = random.uniform(0.0, 0.3) * np.exp(-(((x - k) / 5) ** 2) - ((y - j) / 9) ** 2)
    edge = np.minimum.reduce([x, y, 51 - x, 51 - y]) / 10.0
    change = np.minimum(edge, 1.0) * (heap - hole)
    lost, gained = np.maximum(-change, 0.0).sum(), np.maximum(change, 0.0).sum()
    change = np.where(change > 0.0, min(1.0, lost / max(gained, 1e-9)) * change, change)
    return jnp.asarray(change.astype(dtype))


def numbers(tree: Any) -> list[np.ndarray]:
    """Leaves of a result in float64."""
    return [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(tree)]


def assert_finite(tree: Any) -> None:
    assert all(np.isfinite(leaf).all() for leaf in numbers(tree))


# --- the automaton


@jax.jit
def settled(pile: Pile, weights: jax.Array) -> Any:
    """A settled pile, and the derivative of a weighted sum of its heights."""

    def total(height: jax.Array) -> Any:
        after = settle(pile.replace(height=height))
        return (weights * after.pile.height).sum(), after

    (_, after), gradient = jax.value_and_grad(total, has_aux=True)(pile.height)
    return after, gradient


@given(sorts, seeds)
def test_settling_keeps_the_volume_and_the_floor(sort: Sort, seed: int) -> None:
    pile = pile_of(sort)
    after, gradient = settled(pile, jnp.ones_like(pile.height))
    assert_finite(after)
    assert_volume_kept(pile.height, after.pile.height)
    height, before = (np.asarray(one.height, np.float64) for one in (after.pile, pile))
    assert (height - np.asarray(pile.floor)).min() >= -1e-6
    np.testing.assert_array_equal(height[~np.asarray(pile.valid)], before[~np.asarray(pile.valid)])
    # Soil that is added anywhere is in the sum afterwards: the volume is kept, so its derivative
    # is one. Each round adds rounding of some sweeps.
    rounds = max(int(after.rounds), 1)
    np.testing.assert_allclose(gradient, 1.0, atol=200 * rounds * EPS)
    weights = np.random.default_rng(seed).normal(size=height.shape).astype(np.float32)
    assert_finite(settled(pile, jnp.asarray(weights))[1])


@given(st.tuples(sorts, sorts, sorts))
def test_settling_a_batch_is_settling_its_members(some: tuple[Sort, Sort, Sort]) -> None:
    """Bit by bit, and NaN in one of them stays there."""
    piles = [pile_of(sort) for sort in some]
    weights = jnp.ones_like(piles[0].height)
    batch = many_settled(stacked(piles), weights)
    broken = [piles[0], piles[1].replace(height=piles[1].height * jnp.nan), piles[2]]
    with_nan = many_settled(stacked(broken), weights)
    for n, pile in enumerate(piles):
        for got, want in zip(numbers(batch), numbers(settled(pile, weights)), strict=True):
            np.testing.assert_allclose(got[n], want, atol=4 * EPS, rtol=4 * EPS)
        if n != 1:
            for got, want in zip(numbers(with_nan), numbers(batch), strict=True):
                np.testing.assert_array_equal(got[n], want[n])


many_settled = jax.jit(jax.vmap(settled, in_axes=(0, None)))


def stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


TURNS: dict[str, Callable[[Any], Any]] = {
    "a quarter turn": lambda field: np.rot90(field),
    "half a turn": lambda field: np.rot90(field, 2),
    "a mirror": lambda field: field[::-1],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TURNS)
def test_settling_commutes_with(name: str) -> None:
    """In float64: what the sweeps decide by sums then is decided alike."""
    turn = TURNS[name]

    @settings(max_examples=examples(20))
    @given(sorts)
    def check(sort: Sort) -> None:
        pile = pile_of(sort, np.float64)
        turned = pile.replace(
            **{
                n: jnp.asarray(turn(np.asarray(getattr(pile, n))))
                for n in ("height", "ground", "valid")
            }
        )
        straight = turn(np.asarray(plainly_settled(pile).height))
        np.testing.assert_allclose(plainly_settled(turned).height, straight, atol=1e-9)

    with jax.enable_x64(True):
        check()


@jax.jit
def plainly_settled(pile: Pile) -> Pile:
    return settle(pile).pile


@pytest.mark.slow
@given(sorts)
@settings(max_examples=examples(40))
def test_settling_in_float32_is_settling_in_float64(sort: Sort) -> None:
    """To what a slope between two cells may be too steep: rounding decides when that is enough."""
    pile = pile_of(sort)
    repose, tolerance = GRAVEL.repose_angle, DEFAULT_SCHEDULE.tolerance
    bound = CELL * (math.tan(repose + tolerance) - math.tan(repose))
    exact = in_float64(lambda pile: plainly_settled(pile).height, pile)[0]
    height = plainly_settled(pile).height
    np.testing.assert_allclose(height, exact, atol=bound)
    # That is a few cells; the others differ by rounding.
    assert np.median(abs(np.asarray(height, np.float64) - exact)) < 1e-6


# --- excavation


@jax.jit
def dug(pile: Pile, pose: Pose, volume: jax.Array) -> Any:
    """An excavation, and the derivative of its volume and of a sum of its heights."""

    def total(height: jax.Array, pose: Pose, volume: jax.Array) -> Any:
        after = excavate(pile.replace(height=height), pose, volume, width=WIDTH)
        return after.volume + (after.pile.height**2).sum(), after

    (_, after), gradient = jax.value_and_grad(total, (0, 1, 2), has_aux=True)(
        pile.height, pose, volume
    )
    return after, gradient


volumes = st.sampled_from([0.0, 1e-6, 0.01, 1.0, 3.0, 1e3]) | st.floats(0.0, 4.0, width=32)


@given(sorts, places, seeds, volumes)
@settings(max_examples=examples(25))
def test_what_is_dug_has_left_the_pile(sort: Sort, place: str, seed: int, volume: float) -> None:
    pile = pile_of(sort)
    after, gradient = dug(pile, pose_of(place, seed), jnp.float32(volume))
    assert_finite((after, gradient))
    height, before = (np.asarray(one.height, np.float64) for one in (after.pile, pile))
    gone = before - height
    # Each cell is rounded once to the spacing of numbers of its height.
    rounding = CELL**2 * EPS * float(np.abs(before)[gone != 0.0].sum()) + 1e-7
    missing = float(after.missing)
    assert abs(gone.sum() * CELL**2 + missing - float(after.volume)) <= rounding
    assert abs(missing) <= 4.0 * rounding
    assert 0.0 <= float(after.volume) <= volume
    assert gone.min() >= 0.0
    assert (height - np.asarray(pile.floor)).min() >= -EPS * np.abs(before).max()
    assert not gone[~np.asarray(pile.valid)].any()


@pytest.mark.slow
@given(sorts, places, seeds, volumes)
@settings(max_examples=examples(40))
def test_what_is_dug_in_float32_is_what_is_dug_in_float64(
    sort: Sort, place: str, seed: int, volume: float
) -> None:
    """To the rounding of where cells lie in the cut, there and back."""
    pile, pose = pile_of(sort), pose_of(place, seed)
    after = plainly_dug(pile, pose, jnp.float32(volume))
    height, dug = in_float64(plainly_dug, pile, pose, jnp.float32(volume))
    np.testing.assert_allclose(after[0], height, atol=2.0 * rounding_of_samples(pile, pose))
    np.testing.assert_allclose(after[1], dug, rtol=1e-6, atol=1e-6)


@jax.jit
def plainly_dug(pile: Pile, pose: Pose, volume: jax.Array) -> Any:
    after = excavate(pile, pose, volume, width=WIDTH)
    return after.pile.height, after.volume


# --- local maps


@jax.jit
def local(pile: Pile, pose: Pose) -> Any:
    return sample_local(pile, pose, cells=52, displacement=1.0).height


@given(sorts, places, seeds)
def test_local_maps_are_turned_with_pile_and_pose(sort: Sort, place: str, seed: int) -> None:
    """To the rounding of where samples lie, times how much the surface rises there."""
    pile, pose = pile_of(sort), pose_of(place, seed)
    here = numbers(local(pile, pose))[0]
    assert_finite(here)
    bound = rounding_of_samples(pile, pose)
    fields = ("height", "ground", "valid")

    def turned(turn: Callable[[np.ndarray], np.ndarray]) -> Pile:
        new = {n: jnp.asarray(turn(np.asarray(getattr(pile, n))).copy()) for n in fields}
        return pile.replace(**new)

    low, high = (float(pile.origin[0]) + CELL * k for k in (0, CELLS - 1))
    # The quarter turn takes x to y, and y to what is left of the way to the other side.
    quarter = Pose(low + high - pose.y, pose.x, pose.heading + np.float32(np.pi / 2))
    mirror = Pose(low + high - pose.x, pose.y, np.float32(np.pi) - pose.heading)
    np.testing.assert_allclose(local(turned(lambda f: f.T[::-1]), quarter), here, atol=bound)
    np.testing.assert_allclose(local(turned(lambda f: f[::-1]), mirror)[:, ::-1], here, atol=bound)


def rounding_of_samples(pile: Pile, pose: Pose) -> float:
    """How far two samples may be apart by rounding of their places and of their sums [m].

    Places are sums of some terms as large as the farthest of them, so they are off by some
    spacings of numbers as large; over a cell the surface rises by its largest step at most.
    """
    height = np.asarray(pile.height, np.float64)
    step = max(float(np.abs(np.diff(height, axis=axis)).max()) for axis in (0, 1))
    farthest = abs(float(pose.x)) + abs(float(pose.y)) + CELL * CELLS + 8.0
    return 16.0 * EPS * (farthest / CELL * step + float(np.abs(height).max()))


@given(sorts, places, seeds)
def test_local_maps_of_float32_are_those_of_float64(sort: Sort, place: str, seed: int) -> None:
    pile, pose = pile_of(sort), pose_of(place, seed)
    exact = in_float64(local, pile, pose)
    np.testing.assert_allclose(local(pile, pose), exact[0], atol=rounding_of_samples(pile, pose))


def in_float64(function: Callable[..., Any], *arguments: Any) -> list[np.ndarray]:
    """Leaves of what a function makes of the same numbers in float64."""
    with jax.enable_x64(True):
        exact = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float64) if leaf.dtype == jnp.float32 else leaf,
            arguments,
        )
        return numbers(function(*exact))


@jax.jit
def written(pile: Pile, pose: Pose, change: jax.Array) -> Any:
    """A change written back, and the derivative of a sum of the heights."""

    def total(height: jax.Array, pose: Pose, change: jax.Array) -> Any:
        after, missing = add_local_change(height, pile, pose, change, 1.0)
        return (after**2).sum(), (after, missing)

    (_, after), gradient = jax.value_and_grad(total, (0, 1, 2), has_aux=True)(
        pile.height, pose, change
    )
    return after, gradient


@given(sorts, places, seeds, seeds)
@settings(max_examples=examples(25))
def test_a_change_that_is_written_back_keeps_its_volume(
    sort: Sort, place: str, seed: int, other: int
) -> None:
    pile, change = pile_of(sort), change_of(other)
    (after, missing), gradient = written(pile, pose_of(place, seed), change)
    assert_finite((after, missing, gradient))
    before, height = (np.asarray(one, np.float64) for one in (pile.height, after))
    wanted = CELL**2 * np.asarray(change, np.float64).sum() + float(missing)
    # A sum in float32 of rows of 52 numbers, and of 52 of those, is off by up to half a spacing an
    # addition, of all that is summed: once for the losses, once for the gains. And each cell is
    # rounded to the spacing at its height.
    gross = len(change) * np.abs(np.asarray(change)).sum() + np.abs(before).max() * change.size
    assert abs((height - before).sum() * CELL**2 - wanted) <= CELL**2 * EPS * gross
    lowest = np.minimum(before, np.asarray(pile.floor))
    assert (height - lowest).min() >= -4.0 * EPS * np.abs(before).max() - 1e-9


@pytest.mark.slow
@given(sorts, places, seeds, seeds)
@settings(max_examples=examples(40))
def test_a_change_is_written_in_float32_as_in_float64(
    sort: Sort, place: str, seed: int, other: int
) -> None:
    """To the rounding of where cells lie in the local map, there and back, and of the change."""
    pile, pose, change = pile_of(sort), pose_of(place, seed), change_of(other)
    bound = 2.0 * rounding_of_samples(pile, pose) + 16.0 * EPS * float(jnp.abs(change).max())
    height, missing = plainly_written(pile, pose, change)
    exact, exactly_missing = in_float64(plainly_written, pile, pose, change)
    np.testing.assert_allclose(height, exact, atol=bound)
    np.testing.assert_allclose(missing, exactly_missing, atol=1e-6)


@jax.jit
def plainly_written(pile: Pile, pose: Pose, change: jax.Array) -> Any:
    return add_local_change(pile.height, pile, pose, change, 1.0)


# --- any arguments in a batch


def rows_of(case: str, n: int) -> tuple[Any, ...]:
    """Arguments of a function of `FUNCTIONS`, the n-th of some."""
    sort = Sort("cone", ("slope", "wall", "kerb")[n], ("seen", "spots", "corner")[n], 1.0, n)
    pile, pose = pile_of(sort), pose_of("toe", n)
    window, start = window_of(pile, pose)
    part = window.height[:40, :30] - 0.1 * (n + 1)
    if case == "paste":
        return pile.height, part, jnp.asarray([n + 3, 2 * n], jnp.int32)
    if case == "excavate":
        return pile, pose, jnp.float32(0.5 + n)
    if case == "sample_local":
        return pile, pose
    if case == "settle_dug":
        hole = pile.height.at[20 : 30 + n, 25:45].add(-0.3)
        return pile, jnp.maximum(hole, pile.floor), start
    return pile.height, pile, pose, change_of(n)


def _settle_dug(pile: Pile, hole: jax.Array, start: Any) -> jax.Array:
    return settle_dug(pile, hole, start).pile.height


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "paste": paste,
    "excavate": functools.partial(excavate, width=WIDTH),
    "sample_local": lambda pile, pose: sample_local(pile, pose).height,
    "add_local_change": lambda height, pile, pose, change: add_local_change(
        height, pile, pose, change, 1.0
    ),
    "settle_dug": _settle_dug,
}
ARGUMENTS = {"paste": 3, "excavate": 3, "sample_local": 2, "add_local_change": 4, "settle_dug": 3}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (n in ("settle_dug", "excavate")))
        for n in FUNCTIONS
    ],
)
def test_a_batch_of_any_arguments_is_its_members(name: str) -> None:
    """Whichever of them belong to the batch: some are the same for all members.

    On a CPU, sums over a grid were once wrong where a window was cut at a place that all shared.
    """
    function, count = FUNCTIONS[name], ARGUMENTS[name]
    rows = [rows_of(name, n) for n in range(3)]
    one = jax.jit(function)
    for size in range(1, count + 1):
        for batched in itertools.combinations(range(count), size):
            axes = tuple(0 if k in batched else None for k in range(count))
            given = tuple(
                stacked([row[k] for row in rows]) if k in batched else rows[0][k]
                for k in range(count)
            )
            # Together with what uses it: it was the sum that was wrong.
            whole = jax.jit(lambda *a, axes=axes: jax.vmap(_and_its_sums(function), axes)(*a))
            found, sums = whole(*given)
            for n, row in enumerate(rows):
                member = one(*(row[k] if k in batched else rows[0][k] for k in range(count)))
                for got, total, want in zip(
                    numbers(found), numbers(sums), numbers(member), strict=True
                ):
                    np.testing.assert_allclose(
                        got[n], want, rtol=1e-5, atol=1e-5, err_msg=str(axes)
                    )
                    bound = 1e-5 * max(float(np.abs(want).sum()), 1.0)
                    np.testing.assert_allclose(total[n], want.sum(), atol=bound, err_msg=str(axes))


def _and_its_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """What a function returns, and the sum over each leaf of it."""

    def both(*arguments: Any) -> Any:
        found = function(*arguments)
        return found, jax.tree.map(lambda leaf: leaf.sum(), found)

    return both


@pytest.mark.slow
@pytest.mark.parametrize("name", ["low", "hybrid"])
def test_plans_in_a_batch_are_its_members_and_nan_stays_its_own(name: str) -> None:
    """Plans of two loads on one pile, as planners play them, and on piles of their own."""
    world = wlplan.load_world(name)

    def play(pile: Pile, plan: LoadingPlan) -> Any:
        def cost(plan: LoadingPlan) -> Any:
            outcome = rollout(world, pile, plan)
            return outcome.performance.time.sum() + (outcome.pile.height**2).sum(), outcome

        (_, outcome), gradient = jax.value_and_grad(cost, has_aux=True)(plan)
        return outcome, gradient

    one = jax.jit(play)
    shared, own = (jax.jit(jax.vmap(play, in_axes=(axis, 0))) for axis in (None, 0))

    @settings(max_examples=examples(8))
    @given(st.tuples(sorts, sorts), st.tuples(places, places), seeds)
    def check(some: tuple[Sort, Sort], where: tuple[str, str], seed: int) -> None:
        piles = [pile_of(sort) for sort in some]
        plans = [any_piles.plan_of(where, seed + n, CELLS) for n in range(2)]
        found = shared(piles[0], stacked(plans)), own(stacked(piles), stacked(plans))
        for n in range(2):
            for batch, pile in zip(found, (piles[0], piles[n]), strict=True):
                outcome, gradient = one(pile, plans[n])
                assert_finite((outcome, gradient))
                for got, want in zip(numbers(batch[0]), numbers(outcome), strict=True):
                    np.testing.assert_allclose(got[n], want, rtol=1e-4, atol=1e-4)
        broken = piles[1].replace(height=piles[1].height * jnp.nan)
        with_nan = own(stacked([piles[0], broken]), stacked(plans))
        for got, want in zip(numbers(with_nan), numbers(found[1]), strict=True):
            np.testing.assert_array_equal(got[0], want[0])

    check()
