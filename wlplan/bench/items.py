"""What `wlplan bench` measures, each item beside the figure to beat and the one to reach."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.automaton import converged, settle, settle_dug, steepest_slope
from wlplan.bench.baselines import Rested, aeolis_rest, numba_sweeps, numpy_sweeps, rest
from wlplan.bench.digs import Dig, random_digs, random_pose, relaxed_seed_piles
from wlplan.bench.timing import Timed, Timing, compiled, timed
from wlplan.characteristics import as_vector, characteristics
from wlplan.diggability import edge_poses
from wlplan.heightmap import sample_local
from wlplan.horizon import rollout
from wlplan.machine import GRAVEL
from wlplan.pile import SEED_PILES, toe_contour
from wlplan.planner import plan_loads
from wlplan.sampling import latin_hypercube
from wlplan.types import LoadingPlan, Pile, Pose, World, action_from
from wlplan.units import ACTION_HIGH, ACTION_LOW, CELL_SIZE
from wlplan.worlds import load_world

# The tolerance that every automaton is run to, and the one the result is judged by, which leaves
# room for the rounding of float32 [rad].
_TOLERANCE = math.radians(1.0)
_STEEPEST = math.degrees(GRAVEL.repose_angle + _TOLERANCE) + 1e-3

_LOADS = 40  # of a rollout
_PILES = 64  # of a batch of piles
_LOCATIONS = 150  # of a batch of inferences
_CYCLES, _GROUPS = 64, 4  # simulated at once, and in how many calls that are under way together
_ROLLOUTS = 1024  # of a batch on a GPU
_PLANNED = 15  # loads of a plan
# The pile of the rollouts and the plans: a cone of 30 degrees.
_CONE = SEED_PILES.index(("conical", math.radians(30.0)))


@dataclasses.dataclass(frozen=True)
class Measured:
    """What an item found."""

    compile: float | None = None  # [s]
    run: Timing | None = None
    figures: Mapping[str, float] = dataclasses.field(default_factory=dict)
    note: str = ""  # why nothing was measured


@dataclasses.dataclass(frozen=True)
class Item:
    """Something to measure, and what it should come to."""

    name: str
    title: str
    measure: Callable[[Setup], Measured]
    group: str
    reference: str = ""  # what others take
    target: str = ""  # as the limits say it
    # Figures, or "run" for the median [s], that may be no more, and no less.
    most: Mapping[str, float] = dataclasses.field(default_factory=dict)
    least: Mapping[str, float] = dataclasses.field(default_factory=dict)
    long: bool = False  # left out when it has to be quick

    def met(self, measured: Measured) -> bool | None:
        """Whether the target was reached; None if there is none or nothing was measured."""
        if measured.run is None or not (self.most or self.least):
            return None
        found = {**measured.figures, "run": measured.run.median}
        return all(found[name] <= limit for name, limit in self.most.items()) and all(
            found[name] >= limit for name, limit in self.least.items()
        )


class Setup:
    """What the items share, made when it is first asked for.

    Args:
        seed: Of piles, poses and actions.
        quick: Fewer cases and repeats.
    """

    def __init__(self, *, seed: int, quick: bool):
        self.seed = seed
        self.quick = quick

    def timed(
        self, functions: Sequence[Callable[..., Any]], cases: Sequence[tuple[Any, ...]]
    ) -> list[Timed]:
        """`timing.timed` for about three seconds, or half of one."""
        seconds, least = (0.5, 2) if self.quick else (3.0, 5)
        return timed(functions, cases, seconds=seconds, least=least)

    @functools.cached_property
    def digs(self) -> list[Dig]:
        """Random digs on the seed piles."""
        return random_digs(12 if self.quick else 60, self.seed)

    @property
    def baseline_digs(self) -> list[Dig]:
        """The first of them, for automata that take long; all seed piles are among them."""
        return self.digs[: 6 if self.quick else 24]

    @functools.cached_property
    def piles(self) -> list[Pile]:
        """The relaxed seed piles."""
        return relaxed_seed_piles(self.seed)

    @functools.cached_property
    def world(self) -> World:
        """The low world."""
        return load_world("low")

    @functools.cached_property
    def settle(self) -> tuple[Callable[..., Any], float]:
        """`automaton.settle` of a window, compiled, and the time that took [s]."""
        return compiled(settle, self.digs[0].dug)

    @functools.cached_property
    def settle_dug(self) -> tuple[Callable[..., Any], float]:
        """`automaton.settle_dug` of a dig, compiled, and the time that took [s]."""
        return compiled(_after_a_load, *_loaded(self.digs[0]))

    @functools.cached_property
    def rollout(self) -> tuple[Callable[..., Any], float]:
        """The rollout of `plan` in the low world, compiled, and the time that took [s]."""
        return compiled(rollout, self.world, self.piles[_CONE], self.plan)

    def plans(self, count: int) -> LoadingPlan:
        """Plans around the toe of the cone in random order, random actions; leaves [count, 40]."""
        rng = np.random.default_rng([self.seed, 1])
        poses = edge_poses(toe_contour(self.piles[_CONE]), _LOADS)
        orders = np.stack([rng.permutation(_LOADS) for _ in range(count)])
        return LoadingPlan(
            Pose(*(_floats(np.asarray(v)[orders]) for v in (poses.x, poses.y, poses.heading))),
            action_from(_random_actions(count * _LOADS, rng).reshape(count, _LOADS, 4)),
        )

    @functools.cached_property
    def plan(self) -> LoadingPlan:
        """One of them, leaves [40]."""
        return jax.tree.map(lambda leaf: leaf[0], self.plans(1))


def _floats(values: Any) -> Array:
    return jnp.asarray(values, jnp.float32)


def _random_actions(count: int, rng: np.random.Generator) -> Float[Array, "n 4"]:
    low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
    return _floats(low + (high - low) * latin_hypercube(count, 4, rng))


def _stacked(members: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


# --- the automaton


def _pasted(dig: Dig) -> np.ndarray:
    height = np.asarray(dig.pile.height, np.float64)
    i, j = (int(first) for first in dig.start)
    n, m = dig.dug.height.shape
    height[i : i + n, j : j + m] = dig.dug.height
    return height


def _quality(before: Sequence[Any], after: Sequence[Any], digs: Sequence[Dig]) -> dict[str, float]:
    """The worst over all digs, of the surfaces before and after they slid [m].

    The volume that comes or goes counts against that of the window.
    """
    slope = jax.jit(steepest_slope)
    slopes = [
        float(slope(dig.dug.replace(height=_floats(h)))) for h, dig in zip(after, digs, strict=True)
    ]
    changes = [
        abs(float(np.asarray(h, np.float64).sum() - np.asarray(b, np.float64).sum()))
        / float(np.asarray(dig.dug.height, np.float64).sum())
        for b, h, dig in zip(before, after, digs, strict=True)
    ]
    return {
        "steepest_slope_degrees": math.degrees(max(slopes)),
        "relative_volume_change": max(changes),
    }


def _loaded(dig: Dig) -> tuple[Pile, Array, tuple[Array, Array]]:
    """What `_after_a_load` takes."""
    return dig.pile, dig.dug.height, dig.start


def _after_a_load(pile: Pile, dug: Array, start: tuple[Array, Array]) -> Array:
    return settle_dug(pile, dug, start).height


def _measure_avalanche(setup: Setup) -> Measured:
    run, seconds = setup.settle_dug
    (found,) = setup.timed([run], [_loaded(dig) for dig in setup.digs])
    before = [_pasted(dig) for dig in setup.digs]
    return Measured(seconds, found.timing, _quality(before, found.results, setup.digs))


def _measure_avalanche_gradient(setup: Setup) -> Measured:
    cases = [_loaded(dig) for dig in setup.digs]
    weight = _floats(np.random.default_rng(setup.seed).normal(size=setup.digs[0].pile.height.shape))
    forward, _ = setup.settle_dug
    gradient, seconds = compiled(
        jax.grad(lambda pile, dug, start: (weight * _after_a_load(pile, dug, start)).sum(), 1),
        *cases[0],
    )
    one, both = setup.timed([forward, gradient], cases)
    ratio = both.timing.median / one.timing.median
    return Measured(seconds, both.timing, {"ratio_to_forward": ratio})


def _measure_avalanche_batch(setup: Setup) -> Measured:
    cases = [_loaded(dig) for dig in setup.digs]
    one, _ = setup.settle_dug
    batch = _stacked([cases[k % len(cases)] for k in range(_PILES)])
    many, seconds = compiled(jax.vmap(_after_a_load), *batch)
    (single,) = setup.timed([one], cases)
    (together,) = setup.timed([many], [batch])
    figures = {
        "ratio_to_one": together.timing.median / single.timing.median,
        "seconds_each": together.timing.median / _PILES,
    }
    return Measured(seconds, together.timing, figures)


def _measure_settle(setup: Setup) -> Measured:
    digs = setup.baseline_digs
    settled, seconds = setup.settle
    (found,) = setup.timed([settled], [(dig.dug,) for dig in digs])
    heights = [pile.height for pile in found.results]
    return Measured(
        seconds, found.timing, _quality([dig.dug.height for dig in digs], heights, digs)
    )


def _beside_settle(
    setup: Setup, automaton: Callable[[Pile, np.ndarray], Rested], seconds: float | None
) -> Measured:
    """An automaton on windows, in turn with `settle`.

    Args:
        setup: Holds the digs.
        automaton: Takes a window as a pile and as a NumPy array.
        seconds: What its compiling took [s].
    """
    digs = setup.baseline_digs
    heights = [np.array(dig.dug.height) for dig in digs]
    settled, _ = setup.settle
    found, ours = timed(
        [automaton, lambda window, _: settled(window)],
        [(dig.dug, height) for dig, height in zip(digs, heights, strict=True)],
        seconds=0.0 if setup.quick else 2.0,
    )
    rested: list[Rested] = found.results
    sweeps = [result.sweeps for result in rested if result.sweeps is not None]
    return Measured(
        seconds,
        found.timing,
        {
            "times_settle": found.timing.median / ours.timing.median,
            **_quality(heights, [result.height for result in rested], digs),
            **({"sweeps": float(np.median(sweeps))} if sweeps else {}),
        },
    )


def _measure_xla(setup: Setup) -> Measured:
    run, seconds = compiled(
        functools.partial(converged, tolerance=_TOLERANCE), setup.baseline_digs[0].dug
    )

    def automaton(window: Pile, _: np.ndarray) -> Rested:
        return Rested(run(window).height, None)

    return _beside_settle(setup, automaton, seconds)


_REST = {"cell_size": CELL_SIZE, "repose_angle": GRAVEL.repose_angle, "tolerance": _TOLERANCE}


def _measure_numpy(setup: Setup) -> Measured:
    return _beside_settle(setup, lambda _, height: rest(numpy_sweeps, height, **_REST), None)


def _measure_numba(setup: Setup) -> Measured:
    if find_spec("numba") is None:
        return Measured(note="Numba is not installed: pip install wlplan[bench]")
    start = time.perf_counter()
    numba_sweeps(np.zeros((2, 2), np.float32), 1.0, 1)
    seconds = time.perf_counter() - start
    return _beside_settle(setup, lambda _, height: rest(numba_sweeps, height, **_REST), seconds)


def _measure_aeolis(setup: Setup) -> Measured:
    if find_spec("aeolis") is None:
        return Measured(note="AeoLiS is not installed: pip install aeolis")
    return _beside_settle(setup, lambda _, height: aeolis_rest(height, **_REST), None)


# --- the low world


def _measure_loading(setup: Setup) -> Measured:
    actions = _random_actions(len(setup.digs), np.random.default_rng(setup.seed))
    cases = [
        (setup.world, dig.pile, dig.pose, action_from(action))
        for dig, action in zip(setup.digs, actions, strict=True)
    ]
    run, seconds = compiled(lambda world, *loading: world(*loading), *cases[0])
    (found,) = setup.timed([run], cases)
    return Measured(seconds, found.timing)


def _work_a_tonne(world: World, pile: Pile, plan: LoadingPlan) -> Array:
    performance = rollout(world, pile, plan).performance
    return performance.work.sum() / performance.mass.sum()


def _measure_rollout(setup: Setup) -> Measured:
    run, seconds = setup.rollout
    (found,) = setup.timed([run], [(setup.world, setup.piles[_CONE], setup.plan)])
    return Measured(seconds, found.timing)


def _measure_rollout_gradient(setup: Setup) -> Measured:
    case = (setup.world, setup.piles[_CONE], setup.plan)
    forward, _ = setup.rollout
    gradient, seconds = compiled(jax.grad(_work_a_tonne, 2), *case)
    one, both = setup.timed([forward, gradient], [case])
    figures = {"ratio_to_forward": both.timing.median / one.timing.median}
    memory = gradient.memory_analysis()  # type: ignore[attr-defined]
    if memory is not None:
        figures["temporary_mebibytes"] = memory.temp_size_in_bytes / 2**20
    return Measured(seconds, both.timing, figures)


def _characteristics(setup: Setup, count: int) -> tuple[Array, Array]:
    """Inputs of ψ_low at places around the toe of the cone: characteristics and actions."""
    pile = setup.piles[_CONE]
    poses = jax.tree.map(_floats, edge_poses(toe_contour(pile), count))
    local = jax.jit(jax.vmap(lambda pose: as_vector(characteristics(sample_local(pile, pose)))))
    return local(poses), _random_actions(count, np.random.default_rng(setup.seed))


def _measure_psi_low(setup: Setup) -> Measured:
    inputs = zip(*_characteristics(setup, _LOCATIONS), strict=True)
    cases = [(setup.world.model, *pair) for pair in inputs]  # type: ignore[attr-defined]
    run, seconds = compiled(lambda model, *pair: model(*pair), *cases[0])
    (found,) = setup.timed([run], cases)
    return Measured(seconds, found.timing)


def _measure_psi_low_batch(setup: Setup) -> Measured:
    case = (setup.world.model, *_characteristics(setup, _LOCATIONS))  # type: ignore[attr-defined]
    run, seconds = compiled(lambda model, *pairs: jax.vmap(model)(*pairs), *case)
    (found,) = setup.timed([run], [case])
    return Measured(seconds, found.timing, {"seconds_each": found.timing.median / _LOCATIONS})


def _measure_gpu_rollouts(setup: Setup) -> Measured:
    if jax.default_backend() == "cpu":
        return Measured(note="no GPU")
    return measure_rollouts(setup, _ROLLOUTS)


def measure_rollouts(setup: Setup, count: int) -> Measured:
    """Many rollouts of 40 loads in one call."""
    case = (setup.world, setup.piles[_CONE], setup.plans(count))
    run, seconds = compiled(jax.vmap(rollout, (None, None, 0)), *case)
    (found,) = setup.timed([run], [case])
    return Measured(
        seconds, found.timing, {"loads_per_second": count * _LOADS / found.timing.median}
    )


# --- simulator and planner


def _measure_cycles(setup: Setup) -> Measured:
    rng = np.random.default_rng(setup.seed)
    actions = _random_actions(_CYCLES, rng)
    cycles = []
    for k in range(_CYCLES):
        pile = setup.piles[k % len(setup.piles)]
        cycles.append((pile, random_pose(pile, rng), action_from(actions[k])))
    groups = [_stacked(cycles[k::_GROUPS]) for k in range(_GROUPS)]
    run, seconds = compiled(jax.vmap(load_world("simulator")), *groups[0])
    (found,) = setup.timed([lambda: [run(*group) for group in groups]], [()])
    return Measured(seconds, found.timing, {"cycles_per_second": _CYCLES / found.timing.median})


def _cold_and_warm(plan: Callable[[], Any], seconds: float) -> Measured:
    """A planner compiles on its way: what the first call takes longer counts as that."""
    start = time.perf_counter()
    jax.block_until_ready(plan())
    cold = time.perf_counter() - start
    (found,) = timed([plan], [()], seconds=seconds, warm=True)
    return Measured(max(cold - found.timing.median, 0.0), found.timing)


def _measure_plan(setup: Setup) -> Measured:
    simulator = load_world("simulator")

    def plan() -> Any:
        return plan_loads(
            setup.world, setup.piles[_CONE], loads=_PLANNED, seed=setup.seed, referee=simulator
        ).cost

    return _cold_and_warm(plan, 0.0)


def _measure_first_load(setup: Setup) -> Measured:
    def first(pile: Pile) -> Any:
        return plan_loads(setup.world, pile, loads=1, planner="greedy", seed=setup.seed).cost

    measured = _cold_and_warm(lambda: first(setup.piles[_CONE]), 5.0)
    # The toe of another pile has another length, for which the planner is compiled anew.
    start = time.perf_counter()
    jax.block_until_ready(first(setup.piles[0]))
    return dataclasses.replace(
        measured, figures={"seconds_on_another_pile": time.perf_counter() - start}
    )


_WORLD, _SIMULATOR, _PLANNER, _BASELINES = "low world", "simulator", "planner", "automata"

ITEMS: dict[str, Item] = {
    item.name: item
    for item in (
        Item(
            "avalanche",
            "one relaxation after a loading",
            _measure_avalanche,
            _WORLD,
            "paper 1.1 s; plain XLA to 0.5° of repose 45 ms",
            "≤ 2 ms, ≤ 33°, volume to 1e-6",
            most={"run": 2e-3, "steepest_slope_degrees": _STEEPEST, "relative_volume_change": 1e-6},
        ),
        Item(
            "avalanche-gradient",
            "gradient of it with respect to the heights",
            _measure_avalanche_gradient,
            _WORLD,
            "naive reverse mode 6 × forward",
            "≤ 4 × forward",
            most={"ratio_to_forward": 4.0},
        ),
        Item(
            "avalanche-batch",
            f"{_PILES} piles in one call",
            _measure_avalanche_batch,
            _WORLD,
            target=f"≤ {_PILES} × one",
            most={"ratio_to_one": float(_PILES)},
        ),
        Item("loading", "one loading in the low world", _measure_loading, _WORLD),
        Item(
            "rollout",
            f"{_LOADS} loads in the low world",
            _measure_rollout,
            _WORLD,
            "paper 44.3 s",
            "≤ 0.1 s",
            most={"run": 0.1},
        ),
        Item(
            "rollout-gradient",
            "gradient of it with respect to the plan",
            _measure_rollout_gradient,
            _WORLD,
            "naive reverse mode 11 × forward",
            "≤ 4 × forward",
            most={"ratio_to_forward": 4.0},
        ),
        Item(
            "psi-low",
            "one inference of ψ_low",
            _measure_psi_low,
            _WORLD,
            "paper 0.36 ms",
            "≤ 0.05 ms",
            most={"run": 5e-5},
        ),
        Item(
            "psi-low-batch",
            f"{_LOCATIONS} inferences in one call",
            _measure_psi_low_batch,
            _WORLD,
            "paper 0.36 ms each",
            "≤ 0.05 ms each",
            most={"seconds_each": 5e-5},
        ),
        Item(
            "gpu-rollouts",
            f"{_ROLLOUTS} rollouts of {_LOADS} loads in one call",
            _measure_gpu_rollouts,
            _WORLD,
        ),
        Item(
            "cycles",
            f"{_CYCLES} simulated cycles, {_GROUPS} calls under way",
            _measure_cycles,
            _SIMULATOR,
            "paper 0.1 a second, prototype 185",
            "≥ 300 a second",
            least={"cycles_per_second": 300.0},
        ),
        Item(
            "plan",
            f"a plan of {_PLANNED} loads, as `wlplan plan` makes it",
            _measure_plan,
            _PLANNER,
            "follow-up 792 s",
            "≤ 60 s",
            most={"run": 60.0},
            long=True,
        ),
        Item(
            "first-load",
            "the first load, again, by a warm greedy planner",
            _measure_first_load,
            _PLANNER,
            "follow-up 43 s",
            "≤ 1 s",
            most={"run": 1.0},
            long=True,
        ),
        Item("settle", "windows of the same digs by `settle`", _measure_settle, _BASELINES),
        Item("xla", "plain sweeps, XLA", _measure_xla, _BASELINES),
        Item("numba", "plain sweeps, Numba", _measure_numba, _BASELINES),
        Item("numpy", "plain sweeps, NumPy", _measure_numpy, _BASELINES),
        Item("aeolis", "the avalanches of AeoLiS", _measure_aeolis, _BASELINES),
    )
}
"""Items by name, in the order in which they are shown."""
