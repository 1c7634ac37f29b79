"""Loading as an environment: what gymnasium asks for, and the laws that planners go by."""

import warnings
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, cone
from gymnasium.utils.env_checker import check_env

import wlplan
from wlplan.environment import NAME
from wlplan.environment.episodes import begin, make_episodes, seed_piles, step
from wlplan.environment.gym import LoadingEnv, LoadingVectorEnv
from wlplan.errors import InputError
from wlplan.planning.amounts import MISFIT_COST
from wlplan.types import LoadingPlan, Pile

AMOUNT = wlplan.Tonnes(4.0)
PILES = [cone(), cone(cells=151, radius=4.5)]
DENSITY = 1.7  # of what that world digs [tonne/m^3]


def env_of(**settings: Any) -> LoadingEnv:
    given: dict[str, Any] = {"piles": PILES, "amount": AMOUNT, "limit": 4, "site": SITE, **settings}
    return LoadingEnv(bowl_world, **given)


def choices(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6)).astype(np.float32)


def played(env: LoadingEnv, seed: int) -> list[Any]:
    record: list[Any] = [env.reset(seed=seed)]
    for choice in choices(8, seed):
        record.append(env.step(choice))
        if record[-1][2] or record[-1][3]:
            break
    return record


def test_it_is_what_gymnasium_asks_for() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(
            NAME, world=bowl_world, piles=PILES, amount=AMOUNT, site=SITE, render_mode="rgb_array"
        )
        check_env(env.unwrapped)
    env.reset(seed=0)
    before = np.asarray(env.render(), int)
    env.step(choices(1)[0])
    after = np.asarray(env.render(), int)
    assert before.shape == after.shape
    assert np.abs(before - after).max() > 50


def test_a_seed_makes_the_same_episode() -> None:
    one, same, other = (played(env_of(), seed) for seed in (3, 3, 4))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one[1][1] != other[1][1]
    numbers = {env_of().reset(seed=seed)[1]["pile"] for seed in range(12)}
    assert numbers == {0, 1}


def test_mass_is_what_leaves_the_pile() -> None:
    env = env_of()
    seen, _ = env.reset(options={"pile": 1})
    for choice in choices(2):
        after, _, _, _, info = env.step(choice)
        volume = float((seen["height"] - after["height"]).sum(dtype=np.float64)) * 0.01
        assert volume * DENSITY == pytest.approx(info["mass"], rel=1e-4)
        seen = after
    assert seen["done"][0] == 2.0
    assert seen["missing"][0] == pytest.approx(4.0 - seen["done"][1], abs=1e-5)


def test_an_episode_costs_what_its_plan_costs() -> None:
    env = env_of()
    env.reset(options={"pile": 0})
    rewards, dug, done = [], [], False
    for choice in choices(8):
        state = env._state
        assert state is not None
        stepped = step(env.episodes, state, jnp.asarray(choice))
        dug.append(LoadingPlan(stepped.loading.plan.pose, stepped.loading.plan.action))
        _, reward, terminated, truncated, info = env.step(choice)
        rewards.append(reward)
        done = terminated
        if terminated or truncated:
            break
    plan = jax.tree.map(lambda *leaves: jnp.stack(leaves), *dug)
    pile = jax.tree.map(lambda leaf: leaf[0], env.episodes.courses.pile)
    result = wlplan.play(bowl_world, pile, plan, amount=AMOUNT, objective="delivery", site=SITE)
    assert -sum(rewards) == pytest.approx(float(result.cost), rel=1e-5)
    assert done == (float(result.missing) == 0.0)
    assert info["mass"] == pytest.approx(float(result.rollout.performance.mass[-1]), rel=1e-5)


def test_what_is_missing_is_paid_when_an_episode_is_cut_off() -> None:
    env = env_of(limit=1)
    env.reset(seed=0)
    seen, reward, terminated, truncated, info = env.step(choices(1)[0])
    assert (terminated, truncated) == (False, True)
    assert seen["missing"][0] > 0.0
    assert reward == pytest.approx(-info["cost"] - MISFIT_COST * seen["missing"][0], rel=1e-5)


def test_choices_are_places_headings_and_actions() -> None:
    episodes = env_of().episodes
    state, seen = begin(episodes, 0)
    low = step(episodes, state, jnp.full(6, -1.0)).loading.plan
    high = step(episodes, state, jnp.array([-1.0, 1.0, 5.0, 5.0, 5.0, 5.0])).loading.plan
    np.testing.assert_allclose(jax.tree.leaves(low.action), 0.0, atol=1e-6)
    np.testing.assert_allclose(jax.tree.leaves(high.action), [0.7, 5.0, 0.7, 5.0], rtol=1e-6)
    # Squashed: the ends are not quite reached.
    turned = float(high.pose.heading - low.pose.heading)
    assert np.degrees(turned) == pytest.approx(30.0, abs=0.1)
    # The place of the first number is where the map of the toe says; the cone is its middle.
    middle = step(episodes, state, jnp.array([1.0 / 32.0 - 1.0, 0, 0, 0, 0, 0])).loading.plan
    np.testing.assert_allclose([middle.pose.x, middle.pose.y], seen.toe[0, :2], atol=1e-4)
    np.testing.assert_allclose(np.hypot(*seen.toe[:, :2].T), 4.7, atol=0.1)


def test_what_cannot_be_used_is_refused() -> None:
    with pytest.raises(InputError, match="unknown render mode 'human'"):
        env_of(render_mode="human")
    with pytest.raises(InputError, match="call reset first"):
        env_of().step(choices(1)[0])
    with pytest.raises(InputError, match="there is no pile 7: there are 2"):
        env_of().reset(options={"pile": 7})
    with pytest.raises(InputError, match="no piles"):
        env_of(piles=[])
    coarse = Pile(cone().height, 0.2, (0.0, 0.0))
    with pytest.raises(InputError, match="cells of different sizes"):
        env_of(piles=[cone(), coarse])
    with pytest.raises(InputError, match="one by one"):
        make_episodes(wlplan.load_world("dem"), PILES)
    with pytest.raises(InputError, match="at least 1"):
        LoadingVectorEnv(0, bowl_world)


@pytest.mark.slow
def test_many_are_one_each_and_begin_anew() -> None:
    many = LoadingVectorEnv(3, bowl_world, piles=PILES, amount=AMOUNT, limit=2, site=SITE)
    seen, info = many.reset(seed=1)
    singles = [env_of(limit=2) for _ in range(3)]
    for single, number in zip(singles, info["pile"], strict=True):
        single.reset(options={"pile": int(number)})
    actions = choices(6).reshape(2, 3, 6)
    for action in actions:
        seen, rewards, terminated, truncated, _ = many.step(action)
        alone = [single.step(one) for single, one in zip(singles, action, strict=True)]
        np.testing.assert_allclose(rewards, [found[1] for found in alone], rtol=1e-4)
        np.testing.assert_allclose(
            seen["height"], np.stack([found[0]["height"] for found in alone]), atol=1e-5
        )
    assert (terminated | truncated).all()
    seen, rewards, terminated, truncated, _ = many.step(actions[0])
    assert not (terminated | truncated).any()
    np.testing.assert_array_equal(rewards, 0.0)
    np.testing.assert_array_equal(seen["done"], 0.0)
    assert many.step(actions[0])[0]["done"][:, 0].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.slow
def test_seed_piles_come_in_all_shapes_and_the_default_world_loads_them() -> None:
    piles = seed_piles(3)
    assert len({pile.height.shape for pile in piles}) == 1
    volumes = [float(pile.height.sum()) * 0.01 for pile in piles]
    assert min(volumes) > 50.0
    assert len({round(volume, 3) for volume in volumes}) == 3
    env = LoadingEnv(piles=1, loads=2)
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(np.zeros(6, np.float32))
    assert not terminated
    assert info["mass"] > 1.0
    assert reward == pytest.approx(-info["cost"])
    assert env.step(np.zeros(6, np.float32))[2]
