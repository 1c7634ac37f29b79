"""The scatter of grains: the same seed and loading alike, as wide as the repeats, nothing lost."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wlplan
from experiments.dem_reference import HELD_OUT, _scatter, load
from wlplan.cli import main
from wlplan.types import Action, Performance, Pile, Pose, action_from
from wlplan.worlds.scattered import CORRELATION, DEVIATION, Scattered

SEEDS = 4000
POSE = Pose(jnp.float32(1.0), jnp.float32(2.0), jnp.float32(0.3))
ACTION = action_from(jnp.array([0.3, 2.0, 0.4, 3.0]))


def trench(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """A world that empties some cells, and lays a part of it down beside them."""
    change = jnp.zeros_like(pile.height).at[10:15, 10:20].set(-0.5).at[10:15, 22].set(0.2)
    after = jnp.maximum(pile.height + change, 0.0)
    mass = (pile.height - after).sum() * pile.cell_size**2 * 1.7
    return pile.replace(height=after), Performance(mass, mass + 5.0, 100.0 * mass)


def heap(high: float = 1.0) -> Pile:
    return Pile(jnp.full((30, 30), high).at[12, 12].set(0.1), 0.1)


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    """Logarithms of the factors of many seeds [seeds, 3]."""
    world = wlplan.scattered(trench)
    factors = jax.jit(jax.vmap(lambda seed: world.replace(seed=seed).factors(POSE, ACTION)))
    found: np.ndarray = np.log(np.asarray(factors(jnp.arange(SEEDS))))
    return found


def test_the_factors_spread_and_go_together_as_is_said(drawn: np.ndarray) -> None:
    np.testing.assert_allclose(drawn.std(axis=0), DEVIATION, rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(drawn.T), CORRELATION, atol=0.05)
    np.testing.assert_allclose(np.exp(drawn).mean(axis=0), 1.0, atol=2e-3)


def test_what_is_drawn_is_what_the_repeats_have() -> None:
    found = _scatter(load(HELD_OUT))
    assert (found["surfaces"], found["cycles"]) == (4, 12)
    np.testing.assert_allclose(list(found["deviation"].values()), DEVIATION, atol=5e-4)
    np.testing.assert_allclose(found["correlation"], CORRELATION, atol=5e-3)


@pytest.mark.parametrize("high", [1.0, 0.5])
def test_the_load_is_what_has_left_the_pile(high: float) -> None:
    """Also where the world has dug down to the floor, so that no more can be taken."""
    pile = heap(high)
    world = wlplan.scattered(trench, deviation=(0.1, 0.1, 0.1))
    _, plain = trench(pile, POSE, ACTION)
    after, got = jax.vmap(lambda seed: world.replace(seed=seed)(pile, POSE, ACTION))(jnp.arange(50))
    lost = np.asarray(pile.height, np.float64).sum() - np.asarray(after.height, np.float64).sum(
        (1, 2)
    )
    np.testing.assert_allclose(got.mass, lost * 0.01 * 1.7, rtol=1e-5)
    assert np.asarray(after.height).min() >= 0.0
    more = np.asarray(got.mass) / float(plain.mass)
    assert more.min() < 0.95
    assert (more.max() > 1.05) == (high > 0.5)


def test_the_same_seed_and_loading_come_out_alike_and_others_differ() -> None:
    pile, world = heap(), wlplan.scattered(trench, seed=3)
    play = jax.jit(lambda world, pose, action: world(pile, pose, action)[1])

    def of(world: Scattered, pose: Pose = POSE, action: Action = ACTION) -> list[float]:
        return [float(v) for v in jax.tree.leaves(play(world, pose, action))]

    first = of(world)
    assert of(world) == first
    assert of(wlplan.scattered(trench, seed=3)) == first
    # Rounding makes no other loading.
    assert of(world, POSE.replace(x=POSE.x + 1e-6)) == first
    assert of(world.replace(seed=jnp.asarray(4))) != first
    assert of(world, POSE.replace(x=POSE.x + 0.01)) != first
    assert of(world, action=ACTION.replace(k_bk=ACTION.k_bk + 0.01)) != first
    batch = jax.vmap(lambda x: world(pile, POSE.replace(x=x), ACTION)[1].mass)(
        jnp.array([POSE.x, POSE.x + 0.01])
    )
    np.testing.assert_allclose(batch[0], first[0], rtol=1e-6)


def test_without_deviation_it_is_the_world_itself() -> None:
    pile = heap()
    world = wlplan.scattered(trench, deviation=(0.0, 0.0, 0.0))
    for one, other in zip(
        jax.tree.leaves(world(pile, POSE, ACTION)),
        jax.tree.leaves(trench(pile, POSE, ACTION)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_derivatives_pass() -> None:
    world = wlplan.scattered(trench, seed=1)

    def mass(height: jax.Array) -> jax.Array:
        return world(Pile(height, 0.1), POSE, ACTION)[1].mass

    gradient = jax.grad(mass)(jnp.full((30, 30), 0.4))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0.0


def test_it_says_what_its_world_can_do() -> None:
    world: Any = wlplan.scattered(wlplan.load_world("simulator"))
    assert world.differentiable is False
    assert world.with_derivatives().differentiable is True
    assert hasattr(world, "solve")
    assert not hasattr(wlplan.scattered(trench), "solve")


def test_discrete_elements_scatter_by_themselves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({}))
    assert main(["simulate", "bundled", str(plan), "--engine", "dem", "--scatter", "1"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: discrete elements have a scatter of their own")
    assert len(message.splitlines()) == 1
