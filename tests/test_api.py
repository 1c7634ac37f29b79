"""The Python API as users meet it: without shape checks, with arrays of every kind, with mistakes.

The tests check shapes and types of every call, so what users may get wrong is tried in a process of
its own, which does not.
"""

import json
import subprocess
import sys
from typing import Any

import pytest

_MISUSE = """
import json, math, sys
import jax, jax.numpy as jnp, numpy as np
import wlplan
from wlplan import Action, LoadingPlan, Pile, Pose, Site

def world(pile, pose, action):
    mass = 2.0 + 0.0 * pose.x
    return pile, wlplan.Performance(mass=mass, time=10.0 + action.k_bm, work=300.0 * mass)

x = 0.1 * np.arange(120) - 6.0
cone = np.maximum(0.5 * (4.0 - np.hypot(x[:, None], x[None, :])), 0.0)
pile = Pile(cone, 0.1, (-6.0, -6.0))
good = LoadingPlan(Pose([-3.9], [0.0], [0.0]), Action([0.3], [2.0], [0.4], [3.0]))
hole = Pile(np.where(cone > 1.0, np.nan, cone), 0.1)
cut = Pile(cone[30:90, 30:90], 0.1)
degrees = good.replace(pose=Pose([0.0], [0.0], [90.0]))
outside = good.replace(action=Action([0.9], [2.0], [0.4], [3.0]))

def callback(pile, pose, action):
    shape = jax.ShapeDtypeStruct((), jnp.float32)
    mass = jax.pure_callback(lambda x: np.float32(2.0), shape, pose.x, vmap_method="sequential")
    return pile, wlplan.Performance(mass=mass, time=10.0 + action.k_bm, work=300.0 * mass)

said = wlplan.world(callback, differentiable=False)
small = wlplan.planners.Greedy(poses_per_metre=0.1, actions=2, refined=1, refine_steps=1)
cases = {
    "rollout name": lambda: wlplan.rollout("low", pile, good),
    "play name": lambda: wlplan.play("simulator", pile, good),
    "plan name": lambda: wlplan.plan_loads("hybrid", pile, loads=1),
    "map name": lambda: wlplan.diggability_map("low", pile),
    "no world": lambda: wlplan.rollout(3, pile, good),
    "nan rollout": lambda: wlplan.rollout(world, hole, good),
    "nan plan": lambda: wlplan.plan_loads(world, hole, loads=1),
    "nan map": lambda: wlplan.diggability_map(world, hole),
    "nan relax": lambda: wlplan.relax(hole),
    "degrees": lambda: wlplan.play(world, pile, degrees),
    "degrees rollout": lambda: wlplan.rollout(world, pile, degrees),
    "action": lambda: wlplan.rollout(world, pile, outside),
    "map action": lambda: wlplan.diggability_map(world, pile, action=Action(0.3, 9.0, 0.4, 3.0)),
    "no toe plan": lambda: wlplan.plan_loads(world, cut, loads=1),
    "no toe map": lambda: wlplan.diggability_map(world, cut),
    "no plan": lambda: wlplan.play(world, pile, {"x": 1.0}),
    "lengths": lambda: wlplan.play(world, pile, good.replace(action=Action(0.3, 2.0, 0.4, 3.0))),
    "height map": lambda: wlplan.rollout(world, cone, good),
    "callback gradient": lambda: wlplan.plan_loads(callback, pile, loads=1, planner="gradient"),
    "said gradient": lambda: wlplan.plan_loads(said, pile, loads=1, planner="gradient"),
    "planner class": lambda: wlplan.plan_loads(world, pile, planner=wlplan.planners.Greedy),
    "planner number": lambda: wlplan.plan_loads(world, pile, planner=3),
    "objective number": lambda: wlplan.plan_loads(world, pile, objective=3),
    "nan cost": lambda: wlplan.plan_loads(
        world, pile, loads=1, planner=small, objective=lambda one: one.pose.x * jnp.nan
    ),
}
found = {}
for name, case in cases.items():
    try:
        case()
    except wlplan.InputError as error:
        found[name] = str(error)
    except Exception as error:
        found[name] = f"{type(error).__name__}: {error}"
    else:
        found[name] = "nothing is said"

# A world without a derivative is planned in by trial.
by_trial = wlplan.planners.Greedy(poses_per_metre=0.1, actions=2, refined=1)
found["by trial"] = float(wlplan.plan_loads(said, pile, loads=1, planner=by_trial).cost)

# Arrays of every kind come to the same.
jax_plan = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), good)
numpy_plan = LoadingPlan(
    Pose(np.array([-3.9]), np.array([0.0]), np.zeros(1)),
    Action(*(np.array([v]) for v in (0.3, 2.0, 0.4, 3.0))),
)
costs = [float(wlplan.play(world, pile, plan).cost) for plan in (good, jax_plan, numpy_plan)]
found["costs"] = costs
found["list pile"] = float(wlplan.play(world, Pile(cone.tolist(), 0.1, [-6.0, -6.0]), good).cost)
after, performance = world(pile, Pose(-3.9, 0, 0), Action(0.3, 2, 0.4, 3))
found["numbers"] = float(performance.time)

# Compiled once, also where nobody wrote `jit`.
import logging
class Count(logging.Handler):
    compiled = 0
    def emit(self, record):
        Count.compiled += "XLA compilation" in record.getMessage()
logging.getLogger("jax").addHandler(Count())
logging.getLogger("jax").propagate = False
gradient = jax.grad(lambda plan: wlplan.rollout(world, pile, plan).performance.time.sum())
low = wlplan.load_world("low")
one = jax.tree.map(lambda leaf: leaf[0], jax_plan)
calls = {
    "rollout": lambda: wlplan.rollout(world, pile, jax_plan),
    "grad": lambda: gradient(jax_plan),
    "play": lambda: wlplan.play(world, pile, jax_plan),
    "world": lambda: low(pile, one.pose, one.action),
    "relax": lambda: wlplan.relax(pile),
}
found["compiled again"] = {}
for name, call in calls.items():
    call()
    with jax.log_compiles():
        Count.compiled = 0
        call()
    found["compiled again"][name] = Count.compiled
jax.jit(low)(pile, one.pose, one.action)
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", _MISUSE],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=tmp_path_factory.mktemp("elsewhere"),
    )
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return told


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("rollout name", "the world is the name 'low'"),
        ("play name", "load_world('simulator')"),
        ("plan name", "load_world('hybrid')"),
        ("map name", "load_world('low')"),
        ("no world", "type int"),
        ("nan rollout", "NaN or infinite"),
        ("nan plan", "NaN or infinite"),
        ("nan map", "NaN or infinite"),
        ("nan relax", "NaN or infinite"),
        ("degrees", "math.radians"),
        ("degrees rollout", "90 rad"),
        ("action", "delta_bm is 0.9"),
        ("map action", "k_bm is 9"),
        ("no toe plan", "can start nowhere"),
        ("no toe map", "can start nowhere"),
        ("no plan", "type dict"),
        ("lengths", "shapes"),
        ("height map", "type ndarray"),
        ("callback gradient", "no derivative"),
        ("said gradient", "no derivative"),
        ("planner class", "is no planner"),
        ("planner number", "3 is no planner"),
        ("objective number", "type int"),
        ("nan cost", "finite cost"),
    ],
)
def test_a_mistake_is_one_clear_line(found: dict[str, Any], case: str, words: str) -> None:
    assert words in found[case]
    assert "\n" not in found[case]
    assert not found[case].split(" ")[0].endswith("Error:")


def test_numpy_lists_and_numbers_are_taken_wherever_arrays_are(found: dict[str, Any]) -> None:
    assert found["costs"][0] == found["list pile"] > 0.0
    assert found["costs"] == pytest.approx([found["costs"][0]] * 3, rel=1e-6)
    assert found["numbers"] == 12.0


def test_a_world_that_says_it_has_no_derivative_is_planned_in_by_trial(
    found: dict[str, Any],
) -> None:
    assert found["by trial"] > 0.0


def test_nothing_is_compiled_a_second_time(found: dict[str, Any]) -> None:
    assert found["compiled again"] == dict.fromkeys(
        ("rollout", "grad", "play", "world", "relax"), 0
    )
