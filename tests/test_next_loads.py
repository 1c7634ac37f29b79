"""The next load as a pure function: the toe under a trace, and the search on it."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, cone
from scipy import ndimage

import wlplan
from wlplan.errors import InputError
from wlplan.planning.job import make_job
from wlplan.planning.load_search import LoadSearch
from wlplan.planning.next_loads import NextLoad, best_next
from wlplan.planning.poses import toe_of
from wlplan.planning.replanning import Replanner, next_load, next_loads
from wlplan.planning.traced_toe import traced_toe
from wlplan.site.machine import WA320
from wlplan.terrain.outline_traced import labels_of, outline_of_largest
from wlplan.terrain.outlines import distances_along, largest_outline
from wlplan.terrain.toe import toe_contour
from wlplan.types import Pile

SEARCH = LoadSearch(actions=8, refine_steps=10, refined=4, poses_per_metre=0.5)
RISE = 0.15

_outline = jax.jit(lambda above: outline_of_largest(above, rise=RISE))
_toe = jax.jit(lambda pile: traced_toe(pile, WA320))
_best = jax.jit(lambda job: best_next(job, search=SEARCH))


def field(kind: str) -> np.ndarray:
    x = 0.1 * (np.arange(121) - 60)
    heights = {
        "cone": np.maximum(0.5 * (4.0 - np.hypot(x[:, None], x)), 0.0),
        "over the edge": np.maximum(0.5 * (4.0 - np.hypot(x[:, None] - 5.0, x + 1.0)), 0.0),
        "two": np.maximum(
            0.5 * (2.5 - np.hypot(x[:, None] - 3.0, x)), 0.6 * (2.6 - np.hypot(x[:, None] + 3.0, x))
        ),
        "ring": 0.5 * np.maximum(1.0 - np.abs(np.hypot(x[:, None], x) - 4.0), 0.0),
        "rough": 0.3
        * ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(121, 121)), 4)
        / 0.07,
    }
    height: np.ndarray = np.maximum(heights[kind], 0.0).astype(np.float32)
    return height


@pytest.mark.parametrize("seed", range(3))
def test_what_hangs_together_has_one_number(seed: int) -> None:
    flags = np.random.default_rng(seed).random((60, 47)) < 0.55
    found, expected = np.asarray(labels_of(jnp.asarray(flags))), ndimage.label(flags)[0]
    assert (found[~flags] == -1).all()
    pairs = set(zip(found[flags].tolist(), expected[flags].tolist(), strict=True))
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


@pytest.mark.parametrize("kind", ["cone", "over the edge", "two", "ring", "rough"])
def test_the_line_around_the_largest_is_the_one_of_the_host(kind: str) -> None:
    above = field(kind)
    line = _outline(jnp.asarray(above))
    expected = largest_outline(
        above.astype(float), rise=RISE, origin=np.zeros(2), cell=1.0, width=0.0
    )
    points = np.asarray(line.points) @ np.array([1.0, 1j])
    apart = np.abs(points[:, None] - expected)
    assert apart.min(axis=0).max() < 1e-4
    assert apart.min(axis=1).max() < 1e-4
    assert float(line.length) == pytest.approx(distances_along(expected)[-1], rel=1e-5)
    assert bool(line.closed) == (expected[0] == expected[-1])
    # The pile is on the left: half a cell there it is higher than half a cell to the right.
    ahead = np.diff(points)
    middle, ahead = points[:-1][np.abs(ahead) > 0.3], ahead[np.abs(ahead) > 0.3]
    sides = [middle + side * 1j * ahead / np.abs(ahead) for side in (0.5, -0.5)]
    left, right = (
        ndimage.map_coordinates(above, [side.real, side.imag], order=1, mode="nearest")
        for side in sides
    )
    assert (left > right).mean() > 0.98


def test_no_pile_no_line() -> None:
    assert not bool(_outline(jnp.zeros((121, 121))).exists)


def scenes() -> dict[str, Pile]:
    walled = np.zeros((161, 161), np.float32)
    # A wall across the way of a loader that comes from the west.
    walled[18:20, 60:100] = 2.0
    plain = cone()
    half = np.ones((161, 161), bool)
    half[:, 120:] = False
    return {
        "cone": plain.replace(ground=jnp.zeros((161, 161)), valid=jnp.ones((161, 161), bool)),
        "wall": plain.replace(
            height=jnp.maximum(plain.height, walled),
            ground=jnp.asarray(walled),
            valid=jnp.ones((161, 161), bool),
        ),
        "unseen": plain.replace(ground=jnp.zeros((161, 161)), valid=jnp.asarray(half)),
        "edge": plain.replace(
            height=jnp.roll(plain.height, 50, axis=0).at[:20].set(0.0),
            ground=jnp.zeros((161, 161)),
            valid=jnp.ones((161, 161), bool),
        ),
    }


@pytest.mark.parametrize("name", ["cone", "wall", "unseen", "edge"])
def test_the_toe_is_the_one_of_the_host(name: str) -> None:
    pile = scenes()[name]
    toe, exists = _toe(pile)
    expected = toe_of(toe_contour(pile))
    assert bool(exists)
    assert bool(toe.closed) == bool(expected.closed) == (name == "cone")
    assert abs(int(toe.count) - int(expected.count)) <= 3
    found, known = (np.asarray(one.points)[: int(one.count)] for one in (toe, expected))
    apart = np.hypot(*(found[:, None] - known).transpose(2, 0, 1))
    # Points are 0.1 m apart, and begin elsewhere on a closed line.
    assert np.quantile(apart.min(axis=0), 0.98) < 0.06
    assert np.quantile(apart.min(axis=1), 0.98) < 0.06
    nearest = apart.argmin(axis=1)
    turned = np.asarray(toe.direction)[: len(found)] * np.asarray(expected.direction)[nearest]
    assert np.quantile(turned.sum(axis=1), 0.02) > math.cos(0.1)
    if name != "cone":
        # In order: no step but those across gaps.
        steps = np.hypot(*np.diff(found, axis=0).T)
        assert np.median(steps) == pytest.approx(0.1, abs=0.02)
        assert (steps > 0.3).sum() <= 2


def job(pile: Pile, **options: Any) -> Any:
    return make_job(bowl_world, pile, site=SITE, **options)


@pytest.mark.slow
def test_it_finds_what_the_host_finds() -> None:
    pile = scenes()["cone"]
    found = _best(job(pile))
    expected = Replanner(bowl_world, site=SITE, search=SEARCH, extent=16.1).next_load(pile)
    # Both try a handful of poses, each of its own.
    assert float(found.cost) == pytest.approx(float(expected.cost), rel=0.02)
    again = wlplan.play(
        bowl_world,
        pile,
        jax.tree.map(lambda leaf: leaf[None], wlplan.LoadingPlan(found.pose, found.action)),
        site=SITE,
    )
    assert float(found.performance.mass) == pytest.approx(
        float(again.rollout.performance.mass[0]), rel=1e-4
    )
    assert float(found.cost) == pytest.approx(float(again.cost), rel=0.02)


@pytest.mark.slow
def test_nothing_to_dig_costs_infinitely_much() -> None:
    flat = scenes()["cone"].replace(height=jnp.zeros((161, 161)))
    assert math.isinf(float(_best(job(flat)).cost))


@pytest.mark.slow
def test_a_batch_is_its_members() -> None:
    piles = [scenes()[name] for name in ("cone", "wall")]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *piles)

    def one(pile: Pile) -> NextLoad:
        return best_next(job(pile), search=SEARCH)

    found = jax.jit(jax.vmap(one))(batch)
    for k, pile in enumerate(piles):
        # The job is made on the host here, and under the trace there: walls are found in both.
        alone = _best(job(pile))
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=2e-3, atol=2e-3)


@pytest.mark.slow
def test_the_function_is_pure_under_a_trace_and_takes_many_piles() -> None:
    piles = [cone(), cone(radius=4.0)]
    traced = jax.jit(lambda pile: next_load(bowl_world, pile, site=SITE))
    alone = [traced(pile) for pile in piles]
    many = next_loads(bowl_world, piles, sites=[SITE, SITE], extent=16.1)
    for k, one in enumerate(alone):
        for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=2e-3, atol=2e-3)
    smaller = [cone(cells=140), cone(cells=150)]
    found = next_loads(bowl_world, smaller, sites=[SITE, SITE], extent=16.1)
    assert np.isfinite(np.asarray(found.cost)).all()


def test_mistakes_are_one_clear_line() -> None:
    with pytest.raises(InputError, match=r"^no pile is given: give at least one\.$"):
        next_loads(bowl_world, [])
    with pytest.raises(InputError, match="1 piles and 2 sites"):
        next_loads(bowl_world, [cone()], sites=[SITE, SITE])
    with pytest.raises(InputError, match=r"^pile 1: the scan is 20.0 by 20.0 m"):
        next_loads(bowl_world, [cone(), cone(cells=200)], sites=[SITE, SITE], extent=16.1)
    flat = cone().replace(height=jnp.zeros((161, 161)))
    with pytest.raises(InputError, match=r"^pile 0: Nothing to dig"):
        next_loads(bowl_world, [flat], sites=[SITE], extent=16.1)
    with pytest.raises(InputError, match="under a trace nobody can look for a place"):
        jax.eval_shape(lambda pile: next_load(bowl_world, pile), cone())
