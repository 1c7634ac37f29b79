"""The cheapest next loading, again and again: meant to be hard to beat."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Loads, Outlook
from wlplan.planning.job import Decisions, Job, Standing, beginning, judged, padded, stacked
from wlplan.planning.load_search import LoadSearch, Memory, Ranked, Tried
from wlplan.planning.playing import cost_as_played, counting, play_one
from wlplan.planning.proposals import NothingWorthIt, Progress, Proposals
from wlplan.planning.search import Cusps
from wlplan.planning.stepping import made, score_of_played
from wlplan.planning.watch import Watch, watching
from wlplan.traced import Traced
from wlplan.types import LoadingPlan, Performance, Pile

# So many loads are played in the referee at once, and then the next: mostly the first suffice.
_AT_ONCE = 2
# One is as good there as it was foreseen if its score is off by no more than this [1]. Where
# nothing goes wrong, models err by so much.
_AS_FORESEEN = 0.01


class Chosen(NamedTuple):
    """The load that a planner makes next."""

    decision: Decisions
    score: float  # as of `score_of_next`, to which later loads may not add
    played: LoadPlayed | None = None  # by the referee; None: not played


class LoadPlayed(NamedTuple):
    """What became of a load."""

    dug: LoadingPlan  # where, and by which action
    pile: Pile  # after it
    performance: Performance


class Grown(NamedTuple):
    """A load of a plan that grows."""

    decision: Decisions  # with its truck
    dug: LoadingPlan
    performance: Performance
    standing: Standing  # after it
    memory: Memory  # for the next
    cost: float  # of it, without the wait for a truck


@dataclasses.dataclass(frozen=True)
class Greedy(LoadSearch):
    """Tries many poses and actions for the next loading and refines the best by gradient.

    What a loading leaves to do is judged by what loads are like now: buckets to fill the truck
    with, or tonnes. In a world without a derivative nothing is refined.

    Where there is a referee it plays the best, two at a time, until one is as good there as it was
    foreseen, or all are played; the cheapest is made, on the pile as the referee leaves it. So what
    the planning world does not see, such as a stall, is avoided load by load.
    """

    stage: ClassVar[str] = "greedy"  # as progress has it
    plays_in_referee: ClassVar[bool] = True

    @classmethod
    def by_trial(cls) -> Greedy:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(poses_per_metre=1.0, actions=16, refine_steps=0)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """One plan, leaves [1, N]; arguments as of `Planner.propose`."""
        watch = watching(progress)
        made = self.grow(job, [], loads, np.random.default_rng(seed), watch, says=True)
        watch.keep(plan_of(job, made, loads), cost_of(job, made))
        return Proposals(jax.tree.map(lambda leaf: leaf[None], plan_of(job, made, loads)))

    def grow(
        self,
        job: Job,
        made: list[Grown],
        loads: int,
        random: np.random.Generator,
        watch: Watch,
        *,
        says: bool = False,
    ) -> list[Grown]:
        """Loads until the job is done, or no load is worth it.

        Args:
            job: With its toe.
            made: Loads that are made already.
            loads: Rows of the plan: the most loads, those included.
            random: Source of what is tried.
            watch: Told what it took.
            says: Whether the watch is told of each load.

        Raises:
            NothingWorthIt: If there is none at all.
        """
        made, bare = list(made), job.replace(referee=None)
        standing, memory = (
            (made[-1].standing, made[-1].memory) if made else (beginning(job), Memory())
        )
        while len(made) < loads and not bool(job.amount.is_done(standing.done)):
            tried, memory = self.look(bare, standing, random, watch, memory)
            outlook = memory.outlook
            assert outlook is not None
            left = loads - len(made)
            decision, score, played = self.choose(job, standing, tried, outlook, left, watch)
            if played is None:
                watch.spend(loading=1)
                dug, one = play_one(judged(job), standing, decision)
                played = LoadPlayed(dug, one.pile, one.performance)
            yields = played.pile, played.performance.mass
            after, truck, cost = _made(job.amount, standing, yields, outlook, score)
            if after.done.mass - standing.done.mass < job.amount.least_load():
                break
            standing, decision = after, decision.replace(truck=truck)
            made.append(
                Grown(decision, played.dug, played.performance, standing, memory, float(cost))
            )
            if says:
                watch.keep(plan_of(job, made, loads), -math.inf)
                watch(self.stage, len(made), loads, cost_of(job, made))
        if not made:
            raise NothingWorthIt
        return made

    def choose(
        self,
        job: Job,
        standing: Standing,
        tried: Tried,
        outlook: Outlook,
        left: int,
        watch: Watch,
    ) -> Chosen:
        """The next load.

        Args:
            job: With its toe.
            standing: Before the load.
            tried: Loads that could be made.
            outlook: What the loads after it will be like.
            left: Most loads that are to be made, this one included.
            watch: Told what it took.
        """
        del left
        found = self.best(job.replace(referee=None), standing, tried, outlook, watch)
        if job.referee is not None:
            return _best_in_referee(job, standing, found, outlook, watch)
        best = int(np.argmin(found.scores))
        return Chosen(_row(found.decisions, best), float(found.scores[best]))


def plan_of(job: Job, made: Sequence[Grown], loads: int) -> Decisions:
    """Loads in order as a plan, leaves [N]; rows that are not made have no truck."""
    chosen = [one.decision for one in made]
    is_whole = len(chosen) == loads or bool(job.amount.is_done(made[-1].standing.done))
    if isinstance(job.amount, Loads) and is_whole:
        return stacked(chosen).replace(truck=None)
    return padded(chosen, loads)


def cost_by_thorough_ways(job: Job, made: Sequence[Grown], loads: int) -> float:
    """What the plan costs as it was played, the ways searched for as thoroughly as in a result."""
    truck = plan_of(job, made, loads).truck
    standings = [beginning(job), *(one.standing for one in made)]
    rows = [
        (before, one.dug, one.performance) for before, one in zip(standings, made, strict=False)
    ]
    return cost_as_played(judged(job), truck, rows, standings[-1])


def cost_of(job: Job, made: Sequence[Grown]) -> float:
    """What loads cost, and what they leave undone; without the waits for trucks."""
    return sum(one.cost for one in made) + float(job.amount.rest(made[-1].standing.done))


def scores_in_referee(
    job: Job, standing: Standing, found: Ranked, outlook: Outlook
) -> tuple[Float[np.ndarray, " k"], LoadPlayed]:
    """Scores of loads by what the referee makes of them, infinite where there is none, and that.

    Args:
        job: With its toe and referee.
        standing: Before the load.
        found: The loads, leaves [K].
        outlook: What the loads after it will be like.
    """
    shared, loads = (judged(job), standing, outlook), (found.decisions, found.cusps)
    scores, *played = _scores_as_played(shared, loads)
    return np.nan_to_num(np.asarray(scores), nan=np.inf), LoadPlayed(*played)


def _best_in_referee(
    job: Job, standing: Standing, found: Ranked, outlook: Outlook, watch: Watch
) -> Chosen:
    """The cheapest in the referee of those that have to be played there, see `Greedy`."""
    order = np.argsort(found.scores)
    chosen: Chosen | None = None
    for first in range(0, len(order), _AT_ONCE):
        rows, following = np.split(order[first:], [_AT_ONCE])
        watch.spend(loading=len(rows))
        scores, played = scores_in_referee(job, standing, _row(found, rows), outlook)
        best = int(np.argmin(scores))
        if chosen is None or scores[best] < chosen.score:
            decision, one = _row(found.decisions, rows[best]), _row(played, best)
            chosen = Chosen(decision, float(scores[best]), one)
        if len(following):
            foreseen = float(found.scores[following[0]])
            if chosen.score <= foreseen + _AS_FORESEEN * abs(foreseen):
                break
    assert chosen is not None
    return chosen


def _row(tree: Any, row: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[row], tree)


def _score_as_played(
    shared: tuple[Job, Standing, Outlook], load: tuple[Decisions, Cusps]
) -> tuple[Float[Array, ""], LoadingPlan, Pile, Performance]:
    """Score of a load by what the world of the job makes of it, and that, as `LoadPlayed`."""
    job, standing, outlook = shared
    decision, cusps = load
    one, played = play_one(job, standing, decision)
    made = one, played.performance
    score = _score_of_played(counting(job), standing, made, outlook, cusps)
    return score, one, played.pile, played.performance


_score_of_played = Traced(score_of_played)
_scores_as_played = ParallelMap(_score_as_played, on_core=_score_as_played)
_made = Traced(made)
