"""The next load after every scan: receding horizon, one load at a time.

A scan is laid into a map of a fixed size, so that one of another extent needs no compiling. What is
outside it counts as unseen, and is never part of the pile.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from wlplan.checks import is_traced
from wlplan.errors import InputError
from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Amount, Done, Loads, Trucks, nothing_done
from wlplan.planning.job import (
    Decisions,
    Standing,
    check_knows_enough,
    make_job,
    with_toe,
)
from wlplan.planning.load_search import LoadSearch, Memory
from wlplan.planning.next_loads import NextLoad, best_next, told
from wlplan.planning.objective import Objective
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Pile, World
from wlplan.worlds.capabilities import as_pytree
from wlplan.xla import on_device

EXTENT = 40.0
"""Sides of the largest scan, unless another is given [m]."""

_SEARCH = LoadSearch()


class Replanner:
    """Plans the next load after every scan.

    It remembers what a good action was, how far the job is, and where the truck stands. Call
    `next_load(pile)` with each scan, and `loaded(mass)` with what the bucket then held.

    Args:
        world: World to plan in.
        site: Machine, soil and receiver; without a receiver it has one beside the first pile.
        objective: As for `wlplan.plan_loads`.
        amount: How much is to be loaded; None: on and on.
        search: How next loads are searched for.
        extent: Sides of the largest scan [m].
        seed: Of everything random.

    Raises:
        InputError: At the first scan, as `wlplan.plan_loads`.
    """

    def __init__(
        self,
        world: World,
        *,
        site: Site | None = None,
        objective: str | Objective | Mapping[str, Any] | Callable[..., Any] | None = None,
        amount: Amount | None = None,
        search: LoadSearch = _SEARCH,
        extent: float = EXTENT,
        seed: int = 0,
    ):
        self._world, self._site = world, Site() if site is None else site
        self._amount = Loads(2**30) if amount is None else amount
        self._objective = self._amount.objective if objective is None else objective
        self._search, self._extent = search, extent
        self._random = np.random.default_rng(seed)
        self._done: Done | None = None
        self._memory = Memory()

    @property
    def receiver(self) -> Receiver | None:
        """Where the loader dumps; None before the first scan, if nobody said."""
        return self._site.receiver

    @property
    def is_done(self) -> bool:
        """Whether no further load is wanted."""
        return self._done is not None and bool(self._amount.is_done(self._done))

    def next_load(self, pile: Pile, *, receiver: Receiver | None = None) -> NextLoad:
        """The load to make next.

        Args:
            pile: The pile as it is, of any extent up to the largest.
            receiver: Where the loader dumps, if the truck does not stand where it did.

        Raises:
            InputError: As `wlplan.plan_loads`; if the scan is too large; or if the job is done.
        """
        if self.is_done:
            raise InputError("the job is done: no load is left to plan.")
        if receiver is not None:
            self._site = self._site.replace(receiver=receiver)
        whole, site = in_map(pile, self._site, self._extent)
        job = make_job(
            self._world,
            whole,
            site=site,
            objective=self._objective,
            amount=self._amount,
        )
        check_knows_enough(job)
        self._site = self._site.replace(receiver=job.site.receiver)
        job = with_toe(job)
        done = nothing_done(pile.height.dtype) if self._done is None else self._done
        self._done = done
        standing, watch = Standing(job.pile, done), Watch()
        tried, self._memory = self._search.look(job, standing, self._random, watch, self._memory)
        outlook = self._memory.outlook
        assert outlook is not None
        found = self._search.best(job, standing, tried, outlook, watch)
        row = int(np.argmin(found.scores))
        decision: Decisions
        decision, cusps = jax.tree.map(lambda leaf: leaf[row], (found.decisions, found.cusps))
        if not isinstance(self._amount, Trucks):
            self._memory = self._memory._replace(known=np.asarray(decision.action)[None])
        load: NextLoad = _told(job, standing, decision, cusps)
        return load

    def loaded(self, mass: float, *, left: bool | None = None) -> bool:
        """Tells what the last load held.

        Args:
            mass: By the scale of the loader or the truck [tonne].
            left: Whether the truck has left; None: it does if no further load would make it better.

        Returns:
            Whether the truck leaves.
        """
        outlook = self._memory.outlook
        if self._done is None or outlook is None:
            raise InputError("no load was planned yet: call next_load with a scan first.")
        if not math.isfinite(mass) or mass < 0.0:
            raise InputError(f"a load of {mass:g} t was told: give tonnes, zero or more.")
        number = jnp.asarray(mass, self._done.mass.dtype)
        stays = self._amount.step(self._done, number, jnp.zeros((), bool)).done
        if left is None:
            left = bool(self._amount.should_leave(stays, outlook))
        self._done = self._amount.step(self._done, number, jnp.asarray(left)).done
        return left


def in_map(pile: Pile, site: Site, extent: float) -> tuple[Pile, Site]:
    """A scan in a map of a fixed size, and its site; what is beyond it is unseen ground.

    Args:
        pile: The pile, of any extent up to that.
        site: Its site.
        extent: Sides of the map [m].

    Raises:
        InputError: If it is too large.
    """
    count = round(extent / pile.cell_size)
    if max(pile.height.shape) > count:
        sides = " by ".join(f"{n * pile.cell_size:.1f}" for n in pile.height.shape)
        raise InputError(
            f"the scan is {sides} m, and the largest is {extent:g} m: give the part around the "
            f"pile, or a larger extent."
        )
    # By numpy: each extent would be compiled for.
    widths = [(0, count - n) for n in pile.height.shape]
    height = np.asarray(pile.height)
    floor = np.zeros_like(height) if pile.ground is None else np.asarray(pile.ground)
    seen = np.ones(height.shape, bool) if pile.valid is None else np.asarray(pile.valid)
    ground = np.pad(floor, widths, mode="edge")
    inside = np.pad(np.ones(height.shape, bool), widths)
    whole = Pile(
        height=on_device(np.where(inside, np.pad(height, widths), ground)),
        cell_size=pile.cell_size,
        origin=pile.origin,
        ground=on_device(ground),
        valid=on_device(np.pad(seen, widths)),
    )
    if site.keep_out is not None:
        site = site.replace(keep_out=on_device(np.pad(np.asarray(site.keep_out), widths)))
    return whole, site


def next_load(
    world: World,
    pile: Pile,
    *,
    site: Site | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
    extent: float = EXTENT,
    seed: int = 0,
) -> NextLoad:
    """The next load from a pile; what is compiled serves every scan of up to that extent.

    Under a trace it is a pure function: it passes `jit`, and `vmap` over piles and receivers. The
    site then has to have a receiver, the extent plays no part, and where there is nothing to dig
    the cost is infinite.

    Args:
        world: World to plan in.
        pile: The pile as it is.
        site: Machine, soil and receiver, as for `wlplan.plan_loads`.
        objective: Likewise.
        extent: Sides of the largest scan [m].
        seed: Of everything random.

    Raises:
        InputError: As `Replanner.next_load`; under a trace also without a receiver.
    """
    if is_traced(world, pile, site):
        if site is None or site.receiver is None:
            raise InputError(
                "under a trace nobody can look for a place for the truck: give a site with a "
                "receiver, wlplan.Site(receiver=wlplan.Receiver(x, y, heading))."
            )
        job = make_job(world, pile, site=site, objective=objective)
        check_knows_enough(job)
        return best_next(job, seed=seed)
    planner = Replanner(world, site=site, objective=objective, extent=extent, seed=seed)
    return planner.next_load(pile)


def next_loads(
    world: World,
    piles: Sequence[Pile],
    *,
    sites: Sequence[Site | None] | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
    extent: float = EXTENT,
    seed: int = 0,
) -> NextLoad:
    """The next load from each of several piles, in one call; leaves [n].

    Each core takes one pile at a time, and each of several devices a part of them.

    Args:
        world: World to plan in.
        piles: Of any extents up to the largest, of one cell size.
        sites: Of each pile; all with one machine and soil. None: the WA320 in gravel, with a
            receiver beside each.
        objective: As for `wlplan.plan_loads`.
        extent: Sides of the largest scan [m].
        seed: Of everything random.

    Raises:
        InputError: If there is no pile, or one cannot be planned for: by its number, from 0.
    """
    if not piles:
        raise InputError("no pile is given: give at least one.")
    given = [None] * len(piles) if sites is None else list(sites)
    if len(given) != len(piles):
        raise InputError(f"{len(piles)} piles and {len(given)} sites are given: as many of both.")
    jobs = []
    for number, (pile, site) in enumerate(zip(piles, given, strict=True)):
        try:
            whole, placed = in_map(pile, Site() if site is None else site, extent)
            job = make_job(world, whole, site=placed, objective=objective)
            check_knows_enough(job)
            # Who cannot be dug at is refused before anything is computed.
            with_toe(job)
        except InputError as error:
            raise InputError(f"pile {number}: {error}") from error
        jobs.append(job.replace(world=None))
    if len({jax.tree.structure(job) for job in jobs}) > 1:
        raise InputError(
            "the piles differ in cell size, machine or soil: give those that are alike."
        )
    rows = jax.tree.map(lambda *leaves: on_device(np.stack(leaves)), *jobs)
    found: NextLoad = _of_each(seed)(as_pytree(world), rows)
    return found


@functools.cache
def _of_each(seed: int) -> ParallelMap:
    return ParallelMap(lambda world, job: best_next(job.replace(world=world), seed=seed))


_told = jax.jit(told)
