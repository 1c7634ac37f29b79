"""The cross-entropy method over all loadings at once, sample-efficient as iCEM."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from wlplan.planning.job import Job
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.population import PER_LOAD, Pool, Spread, start_of
from wlplan.planning.proposals import Planner, Progress, Proposals
from wlplan.planning.watch import watching

_GREEDY, _SPREAD = Greedy(), Spread()


@dataclasses.dataclass(frozen=True)
class CrossEntropy:
    """Draws plans from a normal distribution and moves it to the best of them, again and again.

    Of iCEM (Pinneri et al. 2020) it has the kept elites, the momentum, the population that
    decays and the coloured noise, and the mean is played too, in every iteration. What iCEM does
    between two steps of a control loop, to shift mean and elites, has no place here: a plan is made
    once.

    Positions are circular on a closed toe: the elites' are averaged as steps from the mean, the
    short way around. Trucks are those of the plan that it starts at.
    """

    plays_in_referee: ClassVar[bool] = True  # the plan that it starts at

    # Plans drawn in the first iteration, by how much fewer in each after it, and iterations.
    population: int = 64
    decay: float = 1.25
    iterations: int = 16
    # The best plans, to which the distribution moves, and the part of them that is kept.
    elites: int = 10
    keep: float = 0.3
    # The part of its mean and deviation that the distribution keeps.
    momentum: float = 0.1
    # Exponent of the noise over the loads: 0 is white, with more of it neighbours move together.
    colour: float = 0.0
    # Whose plan it starts at, and the first deviation there. None: anywhere on the toe.
    start: Planner | None = _GREEDY
    spread: Spread = _SPREAD
    # How many plans are handed on.
    candidates: int = 16

    @classmethod
    def by_trial(cls) -> CrossEntropy:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(population=24, iterations=6, elites=6, start=Greedy.by_trial())

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The cheapest plans, leaves [K, N]; arguments as of `Planner.propose`.

        The limit is the plan that it starts at, if another planner made that.

        Raises:
            InputError: If that planner plans fixed poses.
        """
        watch = watching(progress)
        near, limit = start_of(self.start, job, loads, self.spread, seed=seed, watch=watch)
        job = job.replace(referee=None)
        pool = Pool(job, watch, self.candidates)
        random = np.random.default_rng([seed, 1])
        mean = np.zeros((near.loads, PER_LOAD))
        deviation = np.ones_like(mean)
        kept, costs_of_kept = np.empty((0, *mean.shape)), np.empty(0)
        for number in range(self.iterations):
            count = max(round(self.population / self.decay**number), 2 * self.elites)
            drawn = mean + deviation * _coloured(random, (count, *mean.shape), self.colour)
            # The mean is better than most samples, and tells nothing of the spread.
            played = pool.play(near.plans(np.concatenate([mean[None], drawn])))
            costs = np.concatenate([played[1:], costs_of_kept])
            plans = np.concatenate([drawn, kept])
            best = np.argsort(costs, kind="stable")[: self.elites]
            best = best[np.isfinite(costs[best])]
            if len(best):
                steps = near.shortest(plans[best] - mean)
                mean = mean + (1.0 - self.momentum) * steps.mean(axis=0)
                deviation = self.momentum * deviation + (1.0 - self.momentum) * steps.std(axis=0)
                best = best[: round(self.keep * self.elites)]
                kept, costs_of_kept = plans[best], costs[best]
            watch("cross entropy", number + 1, self.iterations, pool.least)
        return Proposals(pool.cheapest(), limit=limit)


def _coloured(
    random: np.random.Generator, shape: tuple[int, int, int], exponent: float
) -> Float[np.ndarray, "k n d"]:
    """Normal numbers whose power falls with the frequency over the loads, of variance 1."""
    white = random.standard_normal(shape)
    count = shape[1]
    weight = np.maximum(np.abs(np.fft.fftfreq(count)), 1.0 / count) ** (-0.5 * exponent)
    weight /= np.sqrt((weight**2).mean())
    return np.fft.ifft(np.fft.fft(white, axis=1) * weight[:, None], axis=1).real
