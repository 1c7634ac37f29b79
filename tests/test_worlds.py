"""Worlds: every predictor with every pile state, what they say they can, how their solves end."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wlplan
from wlplan.errors import InputError
from wlplan.models.ensemble import Ensemble
from wlplan.models.storage import load_model
from wlplan.planning.plan import play
from wlplan.terrain.automaton import Schedule, relax
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Action, LoadingPlan, LocalHeightmap, Performance, Pile, Pose
from wlplan.worlds.capabilities import as_pytree, is_differentiable, with_derivatives
from wlplan.worlds.names import ENGINES, FOR_PLANNING, WORLDS
from wlplan.worlds.pile_states import LocalChange, Strip
from wlplan.worlds.shipped import load_world, pretrained_path

Scene = tuple[Pile, Pose, Action]

DENSITY = 1.727  # of gravel [tonne/m^3]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A relaxed cone, and a pose and an action of one loading on it."""
    pile = jax.jit(relax)(seed_pile("conical", slope=np.radians(30.0), height=2.0))
    pose = jax.tree.map(lambda leaf: jnp.float32(leaf[0]), edge_poses(toe_contour(pile), 1))
    return pile, pose, Action(*(jnp.float32(v) for v in (0.4, 2.0, 0.3, 3.0)))


def removed(before: Pile, after: Pile) -> float:
    heights = (np.asarray(pile.height, np.float64).sum() for pile in (before, after))
    return -float(np.subtract(*reversed(list(heights)))) * before.cell_size**2 * DENSITY


@pytest.mark.parametrize(
    ("psi", "phi"),
    [
        # The three others are the worlds that ship under a name.
        ("psi_low", "phi"),
        pytest.param("psi_low", None, marks=pytest.mark.slow),
        pytest.param("psi_high", None, marks=pytest.mark.slow),
        pytest.param("psi_high", "phi", marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_every_predictor_goes_with_every_pile_state(
    scene: Scene, psi: str, phi: str | None
) -> None:
    pile, pose, action = scene
    model = load_model(pretrained_path(psi), psi)
    state: Any = Strip() if phi is None else load_model(pretrained_path(phi), phi)
    world = wlplan.LearnedWorld(model, state)
    after, performance = world(pile, pose, action)
    assert 0.5 < float(performance.mass) < 8.0
    assert removed(pile, after) == pytest.approx(float(performance.mass), rel=1e-4)
    assert float(world.uncertainty(pile, pose, action).mass) > 0.0
    # By name: a world's model and its pile state are chosen apart.
    named = load_world("low", model=pretrained_path(psi), pile_state=phi and pretrained_path(phi))
    np.testing.assert_array_equal(named(pile, pose, action)[0].height, after.height)


def test_a_function_is_a_pile_state(scene: Scene) -> None:
    """φ of one's own: lowers the whole map alike, and says that it keeps the volume."""
    pile, pose, action = scene

    def lowered(
        local: LocalHeightmap, action: jax.Array, volume: jax.Array, ground: jax.Array
    ) -> jax.Array:
        above = jnp.maximum(local.height - ground, 0.0)
        return -above * volume / (0.01 * above.sum())

    model = load_model(pretrained_path("psi_high"), "psi_high")
    lowered.conserves_volume = True  # type: ignore[attr-defined]
    partial: Any = jax.tree_util.Partial(lowered)
    world = wlplan.LearnedWorld(model, LocalChange(partial))
    # A partial hides the attribute: the load is then what was predicted.
    after, performance = world(pile, pose, action)
    assert removed(pile, after) == pytest.approx(float(performance.mass), rel=0.02)


def test_a_pile_state_where_a_predictor_belongs_is_refused() -> None:
    with pytest.raises(InputError, match=r"is a phi: name a model that `wlplan train psi-low`"):
        load_world("low", model=pretrained_path("phi"))
    with pytest.raises(InputError, match=r"is a psi_low: name a model that `wlplan train phi`"):
        load_world("high", pile_state=pretrained_path("psi_low"))
    with pytest.raises(InputError, match="has no models"):
        load_world("simulator", model=pretrained_path("psi_low"))
    with pytest.raises(InputError, match=r"unknown world 'moon': choose one of low, hybrid"):
        load_world("moon")


def test_the_names_are_those_that_load() -> None:
    assert set(FOR_PLANNING) | set(ENGINES) == set(WORLDS)
    for name in WORLDS:
        assert callable(load_world(name))


def test_worlds_say_whether_they_have_a_derivative() -> None:
    said = {name: is_differentiable(load_world(name)) for name in WORLDS}
    assert {name for name, has_one in said.items() if has_one} == {"low", "hybrid", "high"}
    assert said.keys() == WORLDS.keys()
    assert is_differentiable(with_derivatives(load_world("simulator"))) is True

    def mine(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        return pile, Performance(pose.x, pose.y, pose.heading)

    assert is_differentiable(mine) is None
    assert is_differentiable(as_pytree(mine)) is None
    assert is_differentiable(wlplan.world(mine)) is True
    assert is_differentiable(wlplan.world(mine, differentiable=False)) is False


def test_worlds_say_whether_they_have_an_uncertainty(scene: Scene) -> None:
    def mine(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        return pile, Performance(pose.x, pose.y, pose.heading)

    def deviation(pile: Pile, pose: Pose, action: Action) -> Performance:
        return Performance(0.1 * pose.x, pose.y, pose.heading)

    low = load_world("low")
    assert isinstance(low, wlplan.LearnedWorld)
    assert low.has_uncertainty
    assert not getattr(load_world("simulator"), "has_uncertainty", False)
    plain, sure = wlplan.world(mine), wlplan.world(mine, uncertainty=deviation)
    assert (plain.has_uncertainty, sure.has_uncertainty) == (False, True)
    assert float(sure.uncertainty(*scene).mass) == pytest.approx(0.1 * float(scene[1].x))
    with pytest.raises(InputError, match="uncertainty"):
        plain.uncertainty(*scene)
    ensemble = load_model(pretrained_path("psi_low"), "psi_low")
    assert isinstance(ensemble, Ensemble)
    single = ensemble.members
    one = single.replace(params=jax.tree.map(lambda leaf: leaf[0], single.params))
    assert not wlplan.LearnedWorld(one).has_uncertainty


@pytest.mark.parametrize(
    "name",
    [
        "low",
        pytest.param("high", marks=pytest.mark.slow),
        pytest.param("simulator", marks=pytest.mark.slow),
    ],
)
def test_a_solve_is_a_call_that_says_how_it_ended(scene: Scene, name: str) -> None:
    world: Any = load_world(name)
    after, performance, report = world.solve(*scene)
    same, also = world(*scene)
    np.testing.assert_array_equal(after.height, same.height)
    assert float(performance.mass) == float(also.mass)
    assert bool(report.settled)
    assert 1 <= int(report.rounds) < 100
    assert np.degrees(report.steepest_slope) <= 33.0 + 1e-3
    assert abs(float(report.missing)) < 1e-4


@pytest.mark.slow
def test_a_played_plan_says_how_its_solves_ended(scene: Scene) -> None:
    pile, pose, action = scene
    plan = LoadingPlan(*jax.tree.map(lambda leaf: leaf[None], (pose, action)))
    low = load_world("low")
    assert isinstance(low, wlplan.LearnedWorld)
    patient = play(low, pile, plan).solves
    assert patient is not None
    assert patient.settled.tolist() == [True]
    hasty = dataclasses.replace(Schedule(), most_rounds=1)
    ended = play(low.replace(schedule=hasty), pile, plan).solves
    assert ended is not None
    assert ended.rounds.tolist() == [1]
    assert ended.settled.tolist() == [False]
    assert np.degrees(ended.steepest_slope[0]) > 33.5


@pytest.mark.parametrize(
    "name",
    ["low", *(pytest.param(name, marks=pytest.mark.slow) for name in FOR_PLANNING[1:])],
)
def test_worlds_pass_transformations_as_they_are(scene: Scene, name: str) -> None:
    world = with_derivatives(load_world(name))
    after, performance = world(*scene)
    np.testing.assert_allclose(jax.jit(world)(*scene)[0].height, after.height, atol=1e-6)
    twice = jax.vmap(world)(*jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), scene))
    np.testing.assert_allclose(twice[1].mass, [performance.mass] * 2, rtol=1e-4)

    pile, pose, action = scene
    slope = jax.jit(jax.grad(lambda pose: world(pile, pose, action)[1].mass))(pose)
    assert np.isfinite(jax.tree.leaves(slope)).all()
    assert np.any(np.asarray(jax.tree.leaves(slope)) != 0.0)


@pytest.mark.parametrize("kind", ["psi_low", "psi_high", "phi", "stall"])
def test_models_are_functions_to_jax(kind: str) -> None:
    # JAX keeps what it compiled by the function, so that one needs a hash.
    model: Any = load_model(pretrained_path(kind), kind)
    single = getattr(model, "members", model)
    for function in (model, single, LocalChange(model)):
        assert {function: 1}[function] == 1
    cells = 52 if kind == "phi" else 36
    local = LocalHeightmap(jnp.zeros((cells, cells)), 0.1, 0.0)
    more = (jnp.float32(1.0), jnp.zeros((cells, cells))) if kind == "phi" else ()
    action = jnp.array([0.4, 2.0, 0.3, 3.0])
    jax.eval_shape(jax.jit(model), local, action, *more)
