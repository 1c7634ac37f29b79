"""The cheapest of several next loadings by what can follow: the follow-up's tree search."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Done, Outlook, Trucks
from wlplan.planning.descent import descend
from wlplan.planning.job import Decisions, Job, Standing, can_refine, contour_length
from wlplan.planning.load_search import Tried
from wlplan.planning.planners.greedy import Chosen, Greedy
from wlplan.planning.stepping import advance, score_of, score_of_next
from wlplan.planning.watch import Watch


class _Node(NamedTuple):
    """Loads in a row, and where they leave the job."""

    standing: Standing
    cost: float  # of the loads, without waits for trucks, of which every plan has as many
    later: float  # cost of the trucks after the one that is there
    digs: tuple[int, ...] = ()  # rows of the raster of poses
    first: Chosen | None = None  # of the loads


class _Child(NamedTuple):
    """A load that may follow those of a node."""

    parent: _Node
    dig: int
    decision: Decisions
    score: float  # cost of it and of what it leaves to do for the truck that is there
    value: float  # cost of all loads so far and of all that is left to do

    @property
    def first(self) -> Chosen:
        """The first load of the row."""
        return self.parent.first or Chosen(self.decision, self.score)


@dataclasses.dataclass(frozen=True)
class TreeSearch(Greedy):
    """Looks several loads ahead, makes the first of the cheapest row of loads, and looks again.

    As the follow-up (arXiv 2501.06583) has it: a dig every metre along the toe, square to it, at
    each the action that gradient descent finds, the pile after it predicted, and so on to the
    depth. At depth 1 this is their greedy planner. They prune the tree too; how is not in the parts
    of their work that we have. Ours is a beam: at each depth the cheapest rows of loads go on, of
    loads after the same row only such as are dug apart, and of the same digs in another order only
    one. Only of what goes on is the pile after it computed. On a toe of 38 m the defaults at depth
    4 optimise 722 loads for each that is made; theirs, 723.

    What a row leaves to do is judged as the greedy planner does it, by what loads are like now. In
    a world without a derivative the best action that was tried is taken.
    """

    # Loads that are looked ahead; each more takes `width` predictions of all poses a load.
    depth: int = 2
    # Rows of loads that go on at each depth, and how far digs after the same row are apart [m].
    width: int = 6
    apart: float = 2.0
    # Whether poses are refined with the action.
    refine_poses: bool = False
    poses_per_metre: float = 1.0
    offsets: tuple[float, ...] = (0.0,)
    actions: int = 12
    # Poses are further apart than greedy's, so each has ways of its own.
    neighbours: int = 1
    # Poses that are refined at once; all of them are.
    refined: int = 8
    refine_steps: int = 30

    stage: ClassVar[str] = "tree search"

    @classmethod
    def by_trial(cls) -> TreeSearch:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(width=3, poses_per_metre=0.5, actions=8, refine_steps=0)

    def choose(
        self,
        job: Job,
        standing: Standing,
        tried: Tried,
        outlook: Outlook,
        left: int,
        watch: Watch,
    ) -> Chosen:
        """The first load of the cheapest row of loads."""
        job, ended = job.replace(referee=None), list[_Child]()
        nodes = [_Node(standing, 0.0, float(_cost_of_later(job, standing.done, outlook)))]
        for level in range(min(self.depth, left)):
            children = self._children(job, nodes, tried, outlook, watch)
            if level + 1 == min(self.depth, left):
                break
            kept = self._kept(job, children, tried)
            nodes, is_done = self._follow(job, kept, outlook, watch)
            ended += [child for child, over in zip(kept, is_done, strict=True) if over]
            nodes = [node for node, over in zip(nodes, is_done, strict=True) if not over]
            children = []
            if not nodes:
                break
        return min([*ended, *children], key=lambda child: child.value).first

    def _children(
        self, job: Job, nodes: list[_Node], tried: Tried, outlook: Outlook, watch: Watch
    ) -> list[_Child]:
        """A load at every pose after each node, by the best action there.

        The ways keep the cusps that were found before the first load, and move with the poses.
        """
        poses, count = tried.poses, len(tried.poses)
        steps = self.refine_steps if can_refine(job, self.refine_steps) else 0
        # Portions of one shape, however long the toe is; the last pose fills the last one up.
        portions = -(-count // self.refined)
        rows = np.minimum(np.arange(portions * self.refined), count - 1).reshape(portions, -1)
        parts: list[Any] = []
        for node in nodes:
            costs, masses = tried.costs, tried.masses
            if node.digs:
                watch.spend(look=costs.size)
                costs, masses = self._costs(job, node.standing, poses, tried.cusps, tried.actions)
            at = jax.tree.map(lambda leaf: np.asarray(leaf), (poses, tried.cusps, costs, masses))
            standing = _packed(node.standing)
            parts += [(standing, jax.tree.map(lambda leaf, r=row: leaf[r], at)) for row in rows]
        watch.spend(look_gradient=steps * count * len(nodes))
        refine = _refinement(steps, self.refine_rate, self.refine_poses)
        together = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        found = refine((job, outlook, tried.actions), together)
        # One row a node.
        found = jax.tree.map(
            lambda leaf: np.asarray(leaf).reshape(len(nodes), -1, *leaf.shape[2:])[:, :count], found
        )
        children = []
        for n, node in enumerate(nodes):
            for dig in range(count):
                decision, score = jax.tree.map(lambda leaf, at=(n, dig): leaf[at], found)
                value = node.cost + float(score) + node.later
                children.append(_Child(node, dig, decision, float(score), value))
        return children

    def _kept(self, job: Job, children: list[_Child], tried: Tried) -> list[_Child]:
        """The children that go on, see the class."""
        assert job.toe is not None
        closed, length = bool(job.toe.closed), float(contour_length(job))
        positions = tried.poses[:, 0]
        kept: list[_Child] = []
        orders: set[tuple[int, ...]] = set()
        for child in sorted(children, key=lambda child: child.value):
            siblings = [other.dig for other in kept if other.parent is child.parent]
            part = np.abs(positions[siblings] - positions[child.dig])
            away = length * (np.minimum(part, 1.0 - part) if closed else part)
            digs = tuple(sorted((*child.parent.digs, child.dig)))
            if digs in orders or (away < self.apart).any():
                continue
            kept.append(child)
            orders.add(digs)
            if len(kept) == self.width:
                break
        return kept

    def _follow(
        self, job: Job, kept: list[_Child], outlook: Outlook, watch: Watch
    ) -> tuple[list[_Node], list[bool]]:
        """The nodes that children are, and whether the job is done there."""
        watch.spend(loading=len(kept))
        rows = [
            (_packed(child.parent.standing), child.decision, np.asarray(child.score))
            for child in kept
        ]
        together = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        found = jax.tree.map(np.asarray, _followed((job, outlook), together))
        nodes = []
        for k, child in enumerate(kept):
            packed, cost, later, _ = jax.tree.map(lambda leaf, k=k: leaf[k], found)
            standing, digs = _unpacked(job, packed), (*child.parent.digs, child.dig)
            cost = child.parent.cost + float(cost)
            nodes.append(_Node(standing, cost, float(later), digs, child.first))
        return nodes, found[-1].tolist()


_Packed = tuple[Any, Done]
"""A standing as the heights of its pile and what is done: all that differs within a job."""


def _packed(standing: Standing) -> _Packed:
    # Of numpy, which is stacked and shared out without a program for each number of rows.
    packed: _Packed = jax.tree.map(np.asarray, (standing.pile.height, standing.done))
    return packed


def _unpacked(job: Job, packed: _Packed) -> Standing:
    height, done = packed
    return Standing(job.pile.replace(height=height), done)


_At = tuple[Any, Any, Array, Array]
"""Poses [p, 2], cusps of the ways, and cost and mass [tonne] of every action there [p, a]."""


@functools.cache
def _refinement(steps: int, rate: float, poses: bool) -> ParallelMap:
    """`refine((job, outlook, actions), (standing, at))`: the best load at each of some poses.

    Args:
        steps: Of Adam, from the best action that was tried; 0: that action is the best.
        rate: Of Adam.
        poses: Whether it moves the poses too.
    """

    def refine(
        shared: tuple[Job, Outlook, Float[Array, "a 4"]], row: tuple[_Packed, _At]
    ) -> tuple[Decisions, Float[Array, " p"]]:
        (job, outlook, actions), (packed, at) = shared, row
        standing, (place, cusps, costs, masses) = _unpacked(job, packed), at
        scores = jax.vmap(
            jax.vmap(lambda cost, mass: score_of(job, standing, cost, mass, outlook))
        )(costs, masses)
        scores = jnp.where(jnp.isfinite(scores), scores, jnp.inf)
        best = scores.argmin(axis=1)
        starts = Decisions(place[:, 0], place[:, 1], actions[best])
        if steps == 0:
            return starts, scores.min(axis=1)
        length = contour_length(job)

        def score(variables: Decisions, start: Decisions, cusps: Any) -> Array:
            if not poses:
                variables = start.replace(action=variables.action)
            # Metres along the contour, so that one rate suits all variables.
            decisions = variables.replace(position=variables.position / length)
            return score_of_next(job, standing, decisions, outlook, cusps)

        in_metres = starts.replace(position=starts.position * length)
        loads, found = descend(
            lambda variables: jax.vmap(jax.value_and_grad(score))(variables, in_metres, cusps),
            in_metres,
            optax.adam(optax.cosine_decay_schedule(rate, steps)),
            steps,
        )
        return loads.replace(position=loads.position / length), found

    return ParallelMap(refine)


@jax.jit
def _cost_of_later(job: Job, done: Done, outlook: Outlook) -> Float[Array, ""]:
    """Cost of the trucks after the one that is there, by what loads are like now."""
    if not isinstance(job.amount, Trucks):
        return jnp.zeros_like(done.mass)
    empty = done.replace(aboard=jnp.zeros_like(done.aboard))
    trucks = jnp.maximum(job.amount.count - done.trucks - 1, 0)
    return trucks * job.amount.to_go(empty, outlook)


def _follow_one(
    shared: tuple[Job, Outlook], row: tuple[_Packed, Decisions, Float[Array, ""]]
) -> tuple[_Packed, Array, Array, Array]:
    """Where a load leaves the job, its cost, that of later trucks, and whether the job is done."""
    (job, outlook), (packed, decision, score) = shared, row
    before = _unpacked(job, packed)
    after, _, cost = advance(job, before, decision, outlook, score)
    later, is_over = _cost_of_later(job, after.done, outlook), job.amount.is_done(after.done)
    return (after.pile.height, after.done), cost, later, is_over


_followed = ParallelMap(_follow_one)
