"""What an accelerator makes of batches, plans and training, in one go of ten minutes.

Everything that is needed is made on the spot. Each part has its share of the time and leaves out
what would not fit in; what was measured is written after each measurement, so a run that is cut
short loses nothing. On a CPU the batches are smaller, and it takes the same few minutes.
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import wlplan
from experiments._common.places import say
from experiments._common.results import main, write_result
from wlplan.actions import latin_hypercube
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.dataset import VARIABLES, Dataset
from wlplan.io import write_bytes_atomic
from wlplan.planning.amounts import Loads
from wlplan.planning.job import make_job
from wlplan.planning.placement import beside
from wlplan.planning.planners import Gradient, Greedy
from wlplan.planning.playing import costs_and_gradients, cusps_of_plans
from wlplan.planning.rollout import rollout
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.site.site import Site
from wlplan.studies.bench.timing import compiled
from wlplan.studies.diggability import PAPER_ACTION
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.terrain.seed_piles import SEED_PILES
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training import PsiLowSettings, train
from wlplan.types import LoadingPlan, Pile, Pose, action_from

# For all of it [s].
LIMIT = 540.0
# Loads a second that are aimed at on an accelerator.
GOAL = 1e5
# Piles that a batch of diggability maps, of relaxations and of cycles is of; kinds come in turn.
SIDE = 24.0


class Sizes(NamedTuple):
    """How much is measured."""

    loads: int  # of a plan
    worlds: tuple[str, ...]
    batches: tuple[int, ...]  # of rollouts
    gradients: tuple[int, ...]  # batches of plans
    piles: int
    locations: int  # of a diggability map
    cycles: int  # to train on
    epochs: int
    planning: dict[str, Any]  # settings of the search that are not the default


SIZES = {
    "gpu": Sizes(
        15, ("hybrid", "low", "high"), (1, 16, 256, 4096), (1, 16, 256), 64, 150, 4096, 20, {}
    ),
    "cpu": Sizes(15, ("hybrid", "low", "high"), (1, 16), (1, 4), 64, 150, 384, 20, {}),
    "smoke": Sizes(
        2,
        ("low",),
        (1, 2),
        (2,),
        2,
        4,
        96,
        2,
        {"actions": 6, "refine_steps": 2, "poses_per_metre": 0.3},
    ),
}
"""By the platform; of a smoke preset."""


class Clock:
    """What is left of the time, and of a part's share of it.

    Args:
        limit: All of it [s].
        shares: Of the parts, in their order; what one leaves over goes to those after it.
    """

    def __init__(self, limit: float, shares: list[float]):
        self._end = self._of_part = time.perf_counter() + limit
        self._shares = shares

    def begin(self) -> None:
        """The next part begins."""
        now = time.perf_counter()
        part = self._shares[0] / sum(self._shares)
        self._shares = self._shares[1:]
        self._of_part = now + part * max(self._end - now, 0.0)

    def allows(self, seconds: float) -> bool:
        """Whether that fits into the part."""
        return time.perf_counter() + seconds < self._of_part


class Inputs:
    """Piles, plans and cycles, made on the spot."""

    def __init__(self, sizes: Sizes):
        self.sizes, self._random = sizes, np.random.default_rng(0)
        self.rough = [
            _in_a_map(wlplan.seed_pile(kind, slope=slope, seed=seed))
            for seed in range(-(-sizes.piles // len(SEED_PILES)))
            for kind, slope in SEED_PILES
        ][: sizes.piles]
        self.cone = wlplan.relax(wlplan.seed_pile("conical", slope=math.radians(30.0), seed=1))

    def plans(self, count: int) -> LoadingPlan:
        """Digs around the cone in random order, leaves [count, loads]; over all devices."""
        loads = self.sizes.loads
        poses = edge_poses(toe_contour(self.cone), 40)
        rows = np.stack([self._random.permutation(40)[:loads] for _ in range(count)])
        pose = Pose(*(_floats(np.asarray(v)[rows]) for v in (poses.x, poses.y, poses.heading)))
        action = self._actions(count * loads).reshape(count, loads, 4)
        plans = LoadingPlan(pose, action_from(_floats(action)))
        devices = jax.devices()
        if count % len(devices):
            return plans
        mesh = Mesh(np.array(devices), ("plans",))
        laid: LoadingPlan = jax.device_put(plans, NamedSharding(mesh, PartitionSpec("plans")))
        return laid

    def digs(self, each: int) -> tuple[Pile, Pose]:
        """The piles as one, and so many poses around each of them, leaves [piles, each]."""
        poses = [edge_poses(toe_contour(pile), each) for pile in self.rough]
        return _stacked(self.rough), jax.tree.map(_floats, _stacked(poses))

    def cycles(self, count: int) -> tuple[Pile, tuple[Any, ...]]:
        """Piles, and cycles on them: which pile, pose and action, leaves [count]."""
        each = -(-count // len(self.rough))
        piles, poses = self.digs(each)
        which = np.repeat(np.arange(len(self.rough)), each)[:count]
        pose = jax.tree.map(lambda leaf: leaf.reshape(-1)[:count], poses)
        return piles, (jnp.asarray(which), pose, _floats(self._actions(count)))

    def _actions(self, count: int) -> np.ndarray:
        low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
        actions: np.ndarray = low + (high - low) * latin_hypercube(count, 4, self._random)
        return actions


def _floats(values: Any) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


def _stacked(members: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *members)


def _in_a_map(pile: Pile) -> Pile:
    """A seed pile in a map of one size, whatever its own; its ground is level."""
    width = [(0, round(SIDE / pile.cell_size) - n) for n in pile.height.shape]
    return pile.replace(height=jnp.asarray(np.pad(np.asarray(pile.height), width)))


def _measure(
    clock: Clock, function: Callable[..., Any], case: tuple[Any, ...], foreseen: float
) -> tuple[dict[str, Any], Any]:
    """Compile time, time of a call, and memory of one program; and what it returned last."""
    if not clock.allows(foreseen):
        return {"left_out": f"no time was left for {foreseen:.0f} s"}, None
    run, seconds = compiled(function, *case)
    times: list[float] = []
    result = None
    while len(times) < 2 or (len(times) < 20 and clock.allows(times[-1]) and sum(times) < 5.0):
        start = time.perf_counter()
        result = jax.block_until_ready(run(*case))
        times.append(time.perf_counter() - start)
    found = {"compile_s": seconds, "call_s": float(np.median(times[1:])), "calls": len(times) - 1}
    memory = run.memory_analysis()  # type: ignore[attr-defined]
    if memory is not None:
        found["temporary_mib"] = memory.temp_size_in_bytes / 2**20
    return found, result


def _foreseen(found: dict[str, Any], growth: float) -> float:
    """What a program that is so many times as large will take, compiling and two calls [s]."""
    if "left_out" in found:  # neither does what is larger fit
        return math.inf
    return 1.5 * float(found["compile_s"]) + 2.0 * growth * float(found["call_s"])


Rows = Iterator[dict[str, Any]]


def _rollouts(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """Rollouts in a world, in batches."""
    world, last = wlplan.load_world(name), (1, {"compile_s": 0.0, "call_s": 0.0})
    for count in inputs.sizes.batches:
        case = (world, inputs.cone, inputs.plans(count))
        foreseen = _foreseen(last[1], count / last[0])
        found, _ = _measure(clock, jax.vmap(rollout, (None, None, 0)), case, foreseen)
        last = count, found
        yield _a_second(found, "loads", count * inputs.sizes.loads) | {"batch": count}


def _agreement(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """What one plan comes to there and on the processor: how far they are apart, as a part."""
    del clock
    if jax.default_backend() == "cpu":
        return
    plan = jax.tree.map(lambda leaf: leaf[0], inputs.plans(1))
    case = wlplan.load_world(name), inputs.cone, plan
    there = jax.device_get(rollout(*case).performance)
    with jax.default_device(jax.devices("cpu")[0]):
        here = jax.device_get(rollout(*jax.device_get(case)).performance)
    apart = jax.tree.map(lambda a, b: float(np.max(abs(a - b) / abs(b))), there, here)
    yield {"mass": apart.mass, "time": apart.time, "work": apart.work}


def _gradients(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """Costs of plans and their gradients, as the gradient planner has them."""
    world, pile = wlplan.load_world(name), inputs.cone
    job = make_job(world, pile, site=beside(Site(), pile), amount=Loads(inputs.sizes.loads))
    for count in inputs.sizes.gradients:
        if not clock.allows(0.0):
            yield {"batch": count, "left_out": "no time was left"}
            continue
        plans = jax.device_get(inputs.plans(count))
        cusps = cusps_of_plans(job, plans)

        def gradients(plans: LoadingPlan = plans, cusps: Any = cusps) -> Any:
            return costs_and_gradients(job, (plans, cusps))

        found = _twice(gradients)
        yield _a_second(found, "plans", count) | {"batch": count}


def _diggability(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """Diggability maps of many piles in one call."""
    world, sizes = wlplan.load_world(name), inputs.sizes
    piles, poses = inputs.digs(sizes.locations)

    def performance(pile: Pile, pose: Pose) -> Any:
        return jax.vmap(lambda one: world(pile, one, PAPER_ACTION)[1])(pose)

    found, _ = _measure(clock, jax.vmap(performance), (piles, poses), 0.0)
    yield _a_second(found, "locations", sizes.piles * sizes.locations) | {"batch": sizes.piles}


def _relaxations(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """Seed piles with their noise, left to slide, in one call."""
    del name
    piles = _stacked(inputs.rough)
    found, _ = _measure(clock, jax.vmap(wlplan.relax), (piles,), 0.0)
    yield _a_second(found, "piles", len(inputs.rough)) | {"batch": len(inputs.rough)}


def _training(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """Cycles in the simulator in one call, and the training of a ψ_low on them."""
    del name
    sizes, simulator = inputs.sizes, wlplan.load_world("simulator")
    piles, cycles = inputs.cycles(sizes.cycles)

    def cycle(piles: Pile, one: Any) -> Any:
        which, pose, vector = one
        pile = jax.tree.map(lambda leaf: leaf[which], piles)
        seen = as_vector(characteristics(sample_local(pile, pose)))
        return simulator(pile, pose, action_from(vector))[1], seen

    found, made = _measure(clock, jax.vmap(cycle, (None, 0)), (piles, cycles), 0.0)
    yield _a_second(found, "cycles", sizes.cycles) | {"batch": sizes.cycles, "of": "simulation"}
    if made is None or not clock.allows(0.0):
        yield {"of": "training", "left_out": "no time was left"}
        return
    performance, seen = jax.device_get(made)
    data = _dataset(performance, seen, np.asarray(cycles[2]))
    ends: list[float] = []
    settings = PsiLowSettings(epochs=sizes.epochs, batch=min(128, sizes.cycles // 8))
    begin = time.perf_counter()
    train(settings, data, progress=lambda done, total: ends.append(time.perf_counter()))
    steps = np.diff(ends)
    epoch = float(np.median(steps)) if len(steps) else math.nan
    found = {"compile_s": ends[0] - begin - epoch, "call_s": epoch, "calls": len(ends)}
    yield _a_second(found, "cycles", sizes.cycles) | {"batch": sizes.cycles, "of": "training"}


def _dataset(performance: Any, seen: np.ndarray, action: np.ndarray) -> Dataset:
    """Cycles as the training of ψ_low has them; six in a row are split as one."""
    count = len(action)
    columns = {name: np.zeros((count, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    columns |= {name: np.asarray(getattr(performance, name)) for name in ("mass", "time", "work")}
    columns |= {
        "characteristics": seen,
        "action": action,
        "rollout": np.arange(count, dtype=np.int32) // 6,
        "valid": np.asarray(performance.mass) > 0.0,
    }
    return Dataset(**columns, attributes={"seed": 0, "soil": {"density": 1727.0}})


def _planning(clock: Clock, inputs: Inputs, name: str) -> Rows:
    """The greedy and the gradient planner, whole, as a user calls them."""
    world, few = wlplan.load_world(name), inputs.sizes.planning
    planners: dict[str, Any] = {"greedy": Greedy(**few)}
    if not few:
        planners["gradient"] = Gradient()
    for title, planner in planners.items():
        if not clock.allows(0.0):
            yield {"of": title, "left_out": "no time was left"}
            continue

        def plan(planner: Any = planner) -> Any:
            loads = inputs.sizes.loads
            return wlplan.plan_loads(world, inputs.cone, loads=loads, planner=planner).cost

        yield _a_second(_twice(plan), "plans", 1) | {"of": title}


def _twice(call: Callable[[], Any]) -> dict[str, Any]:
    """The first call less the second is about what compiling took."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return {"compile_s": times[0] - times[1], "call_s": times[1], "calls": 1}


def _a_second(found: dict[str, Any], what: str, count: int) -> dict[str, Any]:
    if "left_out" in found:
        return found
    return found | {f"{what}_a_second": count / found["call_s"], "peak_mib": _peak()}


def _peak() -> float:
    """Most memory that was in use at once so far, on the first device, or else of the process."""
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return float(stats["peak_bytes_in_use"]) / 2**20
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


PARTS: dict[str, tuple[Callable[[Clock, Inputs, str], Rows], float]] = {
    "rollouts": (_rollouts, 2.0),
    "diggability": (_diggability, 1.0),
    "relaxation": (_relaxations, 1.0),
    "training": (_training, 1.0),
    "gradients": (_gradients, 2.0),
    "planning": (_planning, 4.0),
    "agreement": (_agreement, 1.0),
}
"""What is measured, by name, in this order, and shares of the time; rollouts in further worlds come
last."""


def run(preset: str, out: Path) -> dict[str, Any]:
    """Measures all parts; what was measured by then is in the folder of results."""
    # Programs that are kept on disk would take no time to compile.
    jax.config.update("jax_enable_compilation_cache", False)
    platform = jax.default_backend()
    sizes = SIZES["smoke" if preset == "smoke" else "cpu" if platform == "cpu" else "gpu"]
    first, *others = sizes.worlds
    todo = [(part, first) for part in PARTS] + [("rollouts", world) for world in others]
    clock, inputs = Clock(LIMIT, [PARTS[part][1] for part, _ in todo]), Inputs(sizes)
    result: dict[str, Any] = {
        "platform": platform,
        "devices": len(jax.devices()),
        "loads": sizes.loads,
        "goal_loads_a_second": GOAL,
        "seconds": 0.0,
        "machine_load": 0.0,
        "rows": [],
    }
    begin = time.perf_counter()
    for part, world in todo:
        clock.begin()
        for row in PARTS[part][0](clock, inputs, world):
            rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}
            result["rows"].append({"part": part, "world": world} | rounded)
            result["seconds"] = round(time.perf_counter() - begin, 1)
            result["machine_load"] = round(os.getloadavg()[0], 2)
            say(json.dumps(result["rows"][-1]))
            write_result("accelerator", preset, result, out)
    return result


def draw(folder: Path) -> None:
    """Loads a second over the size of the batch, by world, beside the goal."""
    result = json.loads((folder / "accelerator.json").read_text())
    figure = new_figure(5.4, 3.4)
    panel = figure.subplots()
    for world, colour in zip(("hybrid", "low", "high"), (BLUE, ORANGE, "black"), strict=True):
        rows = [
            row
            for row in result["rows"]
            if row["part"] == "rollouts" and row["world"] == world and "left_out" not in row
        ]
        if rows:
            batches, rates = ([row[key] for row in rows] for key in ("batch", "loads_a_second"))
            panel.plot(batches, rates, "o-", ms=4, color=colour, lw=1.3, label=world)
    panel.axhline(result["goal_loads_a_second"], color=FAINT, lw=1.0)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel(f"rollouts of {result['loads']} loads in one call", fontsize=8)
    panel.set_ylabel("loads a second", fontsize=8)
    several = f"{result['devices']} × " if result["devices"] > 1 else ""
    panel.set_title(several + result["conditions"]["device"], fontsize=8)
    panel.legend(frameon=False, fontsize=8)
    tidy(panel)
    write_bytes_atomic(folder / "accelerator.png", png_bytes(figure))


if __name__ == "__main__":
    main("accelerator", run, draw)
