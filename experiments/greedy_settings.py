"""What greedy's settings are worth: trials, refinement, plays in the referee, plans made again."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import wlplan
from experiments._common.instances import Instance
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.amounts import Outlook
from wlplan.planning.job import Job, Standing
from wlplan.planning.load_search import LoadSearch, Tried
from wlplan.planning.planners import Greedy, IteratedGreedy
from wlplan.planning.planners.greedy import Chosen, scores_in_referee
from wlplan.planning.watch import Watch
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.worlds.learned import LearnedWorld

PILES = ("prism 0", "cone", "ridge", "bundled")
LOADS, SEEDS = 10, 3
DEFAULT, WHOLE = "as it is", "looks by the whole ensemble"
SETTINGS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    WHOLE: {},
    "0.75 poses a metre": {"poses_per_metre": 0.75},
    "3 poses a metre": {"poses_per_metre": 3.0},
    "one heading a pose": {"offsets": (0.0,)},
    "12 actions": {"actions": 12},
    "48 actions": {"actions": 48},
    "3 poses a metre, 12 actions, a way for four": {
        "poses_per_metre": 3.0,
        "actions": 12,
        "neighbours": 4,
    },
    "a way for each pose": {"neighbours": 1},
    "4 refined": {"refined": 4},
    "16 refined": {"refined": 16},
    "none refined": {"refine_steps": 0},
    "10 steps": {"refine_steps": 10},
    "30 steps": {"refine_steps": 30},
    "60 steps": {"refine_steps": 60},
}
"""Settings of the search of a load that are compared: what is not as it ships."""
# What the referee plays: so many at once, until one is as foreseen to so much [1].
AT_ONCE, AS_FORESEEN = (1, 2), (0.0, 0.01, 0.03)
# Plans from nothing, and how often loads of them are made again.
STARTS, ROUNDS = (1, 2, 3), 6


@dataclasses.dataclass(frozen=True)
class State:
    """What greedy has before a load of a plan, and what all came to that it refined."""

    job: Job  # without its referee
    standing: Standing
    outlook: Outlook
    foreseen: Float[np.ndarray, " k"]  # scores, best first
    played: Float[np.ndarray, " k"]  # in the referee


@dataclasses.dataclass(frozen=True)
class Noting(Greedy):
    """Greedy that writes down what it has before each load."""

    states: list[State] = dataclasses.field(default_factory=list)

    def choose(
        self,
        job: Job,
        standing: Standing,
        tried: Tried,
        outlook: Outlook,
        left: int,
        watch: Watch,
    ) -> Chosen:
        """The next load; arguments as of `Greedy.choose`."""
        bare = job.replace(referee=None)
        found = self.best(bare, standing, tried, outlook, Watch())
        scores, _ = scores_in_referee(job, standing, found, outlook)
        order = np.argsort(found.scores)
        self.states.append(State(bare, standing, outlook, found.scores[order], scores[order]))
        return super().choose(job, standing, tried, outlook, left, watch)


class Whole(LearnedWorld):
    """A world that is foreseen fully where roughly would do."""

    def roughly(self) -> Whole:
        """Itself."""
        return self


def run(preset: str) -> dict[str, Any]:
    """Plans in the hybrid world with the simulator as referee, and tries settings on their way."""
    smoke = preset == "smoke"
    piles, loads, seeds, rounds = (PILES[:1], 2, 1, 1) if smoke else (PILES, LOADS, SEEDS, ROUNDS)
    names = [DEFAULT, WHOLE, "10 steps"] if smoke else list(SETTINGS)
    few: dict[str, Any] = {"actions": 6, "refine_steps": 2, "poses_per_metre": 0.3} if smoke else {}
    states: dict[str, list[State]] = {}
    again = []
    for pile in piles:
        noting = Noting(**few)
        _plan(pile, loads, noting, seed=0)
        states[pile] = noting.states
        for starts in STARTS[:1] if smoke else STARTS:
            planner = IteratedGreedy(starts=starts, rounds=rounds, greedy=Greedy(**few))
            costs = [_costs(pile, loads, planner, seed) for seed in range(seeds)]
            again.append({"pile": pile, "starts": starts, "costs": costs})
            say(json.dumps(again[-1]))
    every = [state for of_pile in states.values() for state in of_pile]
    return {
        "piles": piles,
        "loads": loads,
        "seeds": seeds,
        "states": len(every),
        "settings": _settings(every, names, few, seeds),
        "referee": [_rule(every, k, part) for k in AT_ONCE for part in AS_FORESEEN],
        "plans": again,
        "gains": _gains(again),
    }


def _plan(pile: str, loads: int, planner: Any, seed: int, progress: Any = None) -> None:
    instance = Instance(pile, "15 loads", "fixed truck")
    ground = instance.load_pile()
    wlplan.plan_loads(
        wlplan.load_world("hybrid"),
        ground,
        loads=loads,
        site=instance.site_of(ground),
        planner=planner,
        seed=seed,
        referee=wlplan.load_world("simulator"),
        mend=False,
        progress=progress,
    )


def _costs(pile: str, loads: int, planner: IteratedGreedy, seed: int) -> list[float]:
    """Cost of the best plan after each that was made."""
    costs = []

    def note(stage: str, done: int, total: int, cost: float | None) -> None:
        if stage == "iterated greedy" and cost is not None:
            costs.append(cost)

    _plan(pile, loads, planner, seed, note)
    return costs


def _settings(
    states: Sequence[State], names: Sequence[str], few: dict[str, Any], seeds: int
) -> list[dict[str, Any]]:
    """What settings find before loads, and the processor time that it takes them."""
    rows: list[dict[str, Any]] = []
    base: np.ndarray | None = None
    for name in names:
        search, scores = LoadSearch(**(few | SETTINGS[name])), []
        spent = np.zeros(2)
        # The first time around it compiles.
        for warm, seed in [(False, 0), *((True, seed) for seed in range(seeds))]:
            for state in states:
                job = _whole(state.job) if name == WHOLE else state.job
                start = time.process_time()
                random = np.random.default_rng(seed)
                tried = search.attempt(job, state.standing, random, Watch())
                between = time.process_time()
                found = search.best(job, state.standing, tried, state.outlook, Watch())
                end = time.process_time()
                if warm:
                    scores.append(float(found.scores.min()))
                    spent += between - start, end - between
        of_all = np.array(scores)
        base = of_all if base is None else base
        mean, half = _mean(of_all / base - 1.0)
        look, refine = 1e3 * spent / len(scores)
        rows.append(
            {
                "setting": name,
                "score": {"mean": mean, "half": half},
                "milliseconds": {"look": look, "refine": refine},
            }
        )
        say(json.dumps(rows[-1]))
    return rows


def _whole(job: Job) -> Job:
    world: Any = job.world
    fields = {field.name: getattr(world, field.name) for field in dataclasses.fields(world)}
    whole: Job = job.replace(world=Whole(**fields))
    return whole


def _rule(states: Sequence[State], at_once: int, part: float) -> dict[str, Any]:
    """What a rule of playing in the referee plays, and what more the load costs that it finds."""
    plays, more = [], []
    for state in states:
        count = at_once
        while count < len(state.played):
            foreseen = state.foreseen[count]
            if state.played[:count].min() <= foreseen + part * abs(foreseen):
                break
            count += at_once
        plays.append(min(count, len(state.played)))
        more.append(state.played[:count].min() / state.played.min() - 1.0)
    return {
        "at_once": at_once,
        "as_foreseen": part,
        "plays": float(np.mean(plays)),
        "of": float(np.mean([len(state.played) for state in states])),
        "more": float(np.mean(more)),
    }


def _gains(plans: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Less cost than that of the first plan, after each that was made, over piles and seeds [1]."""
    gains = []
    for starts in dict.fromkeys(row["starts"] for row in plans):
        costs = np.concatenate([row["costs"] for row in plans if row["starts"] == starts])
        less = [_mean(column) for column in (1.0 - costs / costs[:, :1]).T]
        gains.append({"starts": starts, "less": [{"mean": m, "half": h} for m, h in less]})
    return gains


def _mean(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Mean, and half of its interval of 95 %."""
    half = 1.96 * values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(values.mean()), float(half)


def draw(folder: Path) -> None:
    """Settings by time and score, rules by plays and score, and plans by what they gain."""
    result = json.loads((folder / "greedy_settings.json").read_text())
    figure = new_figure(10.5, 3.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    rows = result["settings"]
    places = np.arange(len(rows))
    means = [100.0 * row["score"]["mean"] for row in rows]
    halves = [100.0 * row["score"]["half"] for row in rows]
    left.errorbar(means, places, xerr=halves, fmt="o", color=BLUE, ms=4, lw=1.0)
    left.axvline(0.0, color=FAINT, lw=0.8)
    left.set_yticks(
        places,
        [f"{row['setting']}, {sum(row['milliseconds'].values()):.0f} ms" for row in rows],
        fontsize=7,
    )
    left.invert_yaxis()
    left.set_xlabel("score of the load that is found, more [%]", fontsize=8)
    left.set_title("settings of the search of a load", fontsize=9)
    for at_once, colour in zip(AT_ONCE, (ORANGE, BLUE), strict=True):
        rules = [rule for rule in result["referee"] if rule["at_once"] == at_once]
        plays, more = [rule["plays"] for rule in rules], [100.0 * rule["more"] for rule in rules]
        middle.plot(plays, more, "o-", color=colour, ms=4, lw=1.0, label=f"{at_once} at once")
        for rule, x, y in zip(rules, plays, more, strict=True):
            text = f"{100.0 * rule['as_foreseen']:g} %"
            # Those of two at once lie close: theirs in turn above and below.
            above = at_once == 1 or rule["as_foreseen"] != AS_FORESEEN[1]
            at = (4, 4) if above else (4, -9)
            middle.annotate(text, (x, y), at, textcoords="offset points", size=7)
    middle.set_xlabel(f"plays in the referee, of {result['referee'][0]['of']:g}", fontsize=8)
    middle.set_ylabel("score more than if all are played [%]", fontsize=8)
    middle.set_title("until one is as foreseen to", fontsize=9)
    middle.legend(frameon=False, fontsize=7)
    for row, colour in zip(result["gains"], (ORANGE, BLUE, GREEN), strict=False):
        less = [100.0 * one["mean"] for one in row["less"]]
        numbers = np.arange(1, len(less) + 1)
        right.plot(
            numbers, less, "o-", color=colour, ms=4, lw=1.0, label=f"{row['starts']} from nothing"
        )
    right.set_xlabel("plans that were made", fontsize=8)
    right.set_ylabel("cost less than the first [%]", fontsize=8)
    right.set_title("then loads are made again", fontsize=9)
    right.legend(frameon=False, fontsize=7)
    for panel in (left, middle, right):
        tidy(panel)
        panel.tick_params(labelsize=7)
    write_bytes_atomic(folder / "greedy_settings.png", png_bytes(figure))


if __name__ == "__main__":
    main("greedy_settings", run, draw)
