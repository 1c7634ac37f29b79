"""Random plans on piles of every sort, in every world: what is loaded is what left the pile.

`make soak` plays 10,000 of them in each world.
"""

from __future__ import annotations

from typing import NamedTuple

import any_piles
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_no_soil_from_nowhere

import wlplan
from wlplan.planning.rollout import rollout
from wlplan.site.soil import GRAVEL
from wlplan.types import LoadingPlan, Performance, Pile, Rollout

CELLS, LOADS, AT_ONCE = 100, 3, 50
DENSITY = GRAVEL.density / 1000.0  # [tonne/m^3]


class Case(NamedTuple):
    """A pile and a plan for it."""

    pile: Pile
    plan: LoadingPlan
    name: str


def case_of(number: int) -> Case:
    """A case by its number; every third one digs again and again at one place."""
    random = np.random.default_rng((11, number))
    sort = any_piles.random_sort(random)
    weights = [0.4, 0.25, 0.15, 0.15, 0.05]
    places = tuple(map(str, random.choice(any_piles.PLACES, LOADS, p=weights)))
    plan = any_piles.plan_of(places, int(random.integers(2**31)), CELLS)
    if number % 3 == 0:
        plan = jax.tree.map(lambda leaf: jnp.full_like(leaf, leaf[0]), plan)
    return Case(any_piles.pile_of(sort, CELLS), plan, f"plan {number}: {sort}, {places}")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["low", "high", "hybrid", "simulator"])
def test_what_is_loaded_is_what_left_the_pile(name: str, request: pytest.FixtureRequest) -> None:
    """All is finite, mass, time and work are not negative, nothing is dug below its floor."""
    world, plans = wlplan.load_world(name), request.config.getoption("--plans")

    @jax.jit
    def play(pile: Pile, plan: LoadingPlan) -> Rollout:
        played: Rollout = jax.lax.map(lambda row: rollout(world, *row), (pile, plan))
        return played

    worst, empty, wrong = 0.0, 0, list[str]()
    for start in range(0, plans, AT_ONCE):
        cases = [case_of(number) for number in range(start, start + AT_ONCE)]
        rows = [(case.pile, case.plan) for case in cases]
        found = play(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows))
        outcomes = jax.tree.map(np.asarray, found)
        for n, case in enumerate(cases):
            outcome = jax.tree.map(lambda leaf, n=n: leaf[n], outcomes)
            try:
                worst = max(worst, check(case, outcome))
            except AssertionError as failure:
                wrong.append(f"{case.name}: {failure}")
            empty += int((outcome.performance.mass < 0.01).sum())
    # For docs/reliability.md, see there.
    print(f"{name}: {plans} plans, off by {1e6 * worst:.2g} g at most, {empty} empty loads")
    assert not wrong, f"{len(wrong)} of {plans}: {wrong[:10]}"
    assert empty < 0.7 * LOADS * plans


def check(case: Case, outcome: Rollout) -> float:
    """Sees that an outcome keeps the laws; returns how far the ledger is off [tonne]."""
    for leaf in jax.tree.leaves(outcome):
        assert np.isfinite(leaf).all(), "not finite"
    for quantity in jax.tree.leaves(outcome.performance):
        assert (quantity >= 0.0).all(), f"negative: {quantity}"
    mass = float(np.asarray(outcome.performance.mass, np.float64).sum())
    return assert_no_soil_from_nowhere(
        case.pile, outcome.pile, mass, density=DENSITY, absolute=LOADS * 1e-6
    )


def test_the_check_can_fail() -> None:
    case = case_of(1)
    nothing = Rollout(Performance(*(jnp.zeros(LOADS),) * 3), case.pile)
    assert check(case, nothing) < 1e-9
    one = jnp.asarray([1.0, 0.0, 0.0])
    for mass, told in ((one, "left the pile"), (-one, "negative"), (one / 0.0, "not finite")):
        wrong = nothing.replace(performance=nothing.performance.replace(mass=mass))
        with pytest.raises(AssertionError, match=told):
            check(case, wrong)
