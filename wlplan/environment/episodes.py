"""Episodes of loading as pure functions: `begin` and `step` pass `jit` and `vmap`.

A step is one loading with its transport. It counts what the planners count, and a plan that is
played by `wlplan.play` costs the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from wlplan.constants import ACTION_HIGH, ACTION_LOW, CELL_SIZE
from wlplan.errors import InputError
from wlplan.planning.amounts import Amount, Loads
from wlplan.planning.job import Job, Standing, beginning, decided, make_job, with_toe
from wlplan.planning.objective import Objective
from wlplan.planning.playing import Assessed, assess
from wlplan.planning.poses import Toe, pose_at
from wlplan.planning.yard import Yard
from wlplan.site.site import Site
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.types import LoadingPlan, Pile, Pose, World, action_from
from wlplan.worlds.capabilities import as_pytree

CHOICES = 6
"""Numbers that an agent chooses: place along the toe, heading, the four of the action."""

PLACES = 32
"""Places of the toe that an agent is shown."""

# An offset of the heading is squashed: its ends are out of reach.
_LARGEST_OFFSET = 0.999


@no_type_check
class Course(struct.PyTreeNode):
    """Where an episode begins; leaves with a leading axis if there are several."""

    pile: Pile
    site: Site  # with its receiver
    yard: Yard
    amount: Amount
    toe: Toe


@no_type_check
class Episodes(struct.PyTreeNode):
    """A world, and courses to load in it."""

    world: World
    courses: Course  # leaves [K, ...], all on grids of one size
    objective: Objective = struct.field(pytree_node=False)
    limit: Int[Array, ""]  # loads after which an episode is cut off

    @property
    def count(self) -> int:
        """Number of courses."""
        return len(self.courses.pile.height)


@no_type_check
class State(struct.PyTreeNode):
    """Where an episode stands."""

    course: Course
    standing: Standing


@no_type_check
class Observation(struct.PyTreeNode):
    """What an agent sees. Places are from the middle of the map, along the axes of the world."""

    height: Float[Array, "nx ny"]  # of the surface above the floor [m]
    toe: Float[Array, "32 4"]  # evenly along it: x, y [m], cosine and sine of the heading
    truck: Float[Array, "4"]  # where the loader dumps, likewise
    done: Float[Array, "4"]  # loads, tonnes, trucks that left, tonnes aboard the one that is there
    missing: Float[Array, "1"]  # of the amount [tonne]


@no_type_check
class Stepped(struct.PyTreeNode):
    """What a step comes to."""

    state: State
    observation: Observation
    reward: Float[Array, ""]  # minus the cost; at the end also of what is missing
    terminated: Bool[Array, ""]  # the amount is done
    truncated: Bool[Array, ""]  # it is not, and the loads are used up
    loading: Assessed  # the loading with all that it counts


def seed_piles(count: int, *, seed: int = 0, cell_size: float = CELL_SIZE) -> list[Pile]:
    """Piles at rest: the shapes and slopes of the paper in turn, each with noise of its own."""
    made = []
    for number in range(count):
        kind, slope = SEED_PILES[number % len(SEED_PILES)]
        noise = int(np.random.default_rng((seed, number)).integers(2**31))
        made.append(seed_pile(kind, slope=slope, seed=noise, cell_size=cell_size))
    # Level ground goes on around a seed pile, so all of it is known; one size is compiled once.
    return [relax(_grown(pile, _largest(made)).replace(valid=None)) for pile in made]


def _largest(piles: Sequence[Pile]) -> tuple[int, ...]:
    """The least size of a grid that holds each of the piles."""
    sizes = zip(*(pile.height.shape for pile in piles), strict=True)
    return tuple(max(along) for along in sizes)


def make_episodes(
    world: World,
    piles: Sequence[Pile],
    *,
    amount: Amount | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] | None = None,
    site: Site | None = None,
    limit: int | None = None,
) -> Episodes:
    """Episodes on piles; smaller maps grow to the size of the largest, by ground that is unseen.

    Args:
        world: What plays the loadings; no discrete elements, which are played one by one.
        piles: At least one, with cells of one size.
        amount: To be loaded; default: ten loads.
        objective: As for `wlplan.play`; default: what a plan for the amount is to minimise.
        site: Likewise.
        limit: Loads after which an episode is cut off; default: as many as are asked for, or 100.

    Raises:
        InputError: If something cannot be used.
    """
    wanted = Loads(10) if amount is None else amount
    if hasattr(world, "play_load"):
        raise InputError(
            "this world plays loads one by one: take a learned world or the simulator."
        )
    if not piles:
        raise InputError("there are no piles to load from: give at least one.")
    if len({pile.cell_size for pile in piles}) != 1:
        raise InputError("the piles have cells of different sizes: give piles of one cell size.")
    most = limit or (int(wanted.count) if isinstance(wanted, Loads) else 100)
    if most < 1:
        raise InputError(f"episodes of {most} loads make no sense: give at least 1.")
    shape = _largest(piles)
    jobs = []
    for pile in piles:
        of_pile = wanted.of(pile, (Site() if site is None else site).soil)
        jobs.append(
            with_toe(
                make_job(
                    world,
                    _grown(pile, shape),
                    site=site,
                    objective=wanted.objective if objective is None else objective,
                    amount=of_pile,
                )
            )
        )
    points = max(len(_toe(job).points) for job in jobs)
    courses = [
        Course(job.pile, job.site, job.yard, job.amount, _lengthened(_toe(job), points))
        for job in jobs
    ]
    together = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *courses)
    return Episodes(as_pytree(world), together, jobs[0].objective, jnp.asarray(most, jnp.int32))


def begin(episodes: Episodes, number: Int[Array, ""] | int) -> tuple[State, Observation]:
    """The begin of an episode.

    Args:
        episodes: Of which kind.
        number: Of the course, from 0.
    """
    began: tuple[State, Observation] = _begin(episodes, jnp.asarray(number, jnp.int32))
    return began


@jax.jit
def _begin(episodes: Episodes, number: Int[Array, ""]) -> tuple[State, Observation]:
    course: Course = jax.tree.map(lambda leaf: leaf[number], episodes.courses)
    state = State(course, beginning(_job(episodes, course)))
    return state, observe(state)


def step(episodes: Episodes, state: State, choice: Float[Array, "6"]) -> Stepped:
    """One loading.

    Args:
        episodes: Of which kind.
        state: Before it.
        choice: Six numbers from -1 to 1: place along the toe of the pile as it was at the begin,
            from one end to the other or once around; heading, from 15° right of straight into the
            pile to 15° left; the four parameters of the action, over their ranges. What is beyond
            is held there.
    """
    stepped: Stepped = _step(episodes, state, choice)
    return stepped


@jax.jit
def _step(episodes: Episodes, state: State, choice: Float[Array, "6"]) -> Stepped:
    job, standing = _job(episodes, state.course), state.standing
    one = decided(job, standing, chosen(state, choice))
    after, performance = job.world(standing.pile, one.pose, one.action)
    loading, done = assess(job, standing, one, performance)
    standing = Standing(after, done)
    terminated = job.amount.is_done(done)
    truncated = ~terminated & (done.loads >= episodes.limit)
    cost = loading.cost + jnp.where(terminated | truncated, job.amount.rest(done), 0.0)
    state = State(state.course, standing)
    return Stepped(state, observe(state), -cost, terminated, truncated, loading)


def chosen(state: State, choice: Float[Array, "6"]) -> LoadingPlan:
    """Pose and action of a choice, see `step`."""
    inside = jnp.clip(choice, -1.0, 1.0)
    offset = jnp.arctanh(_LARGEST_OFFSET * inside[1])
    pose = pose_at(state.course.toe, state.standing.pile, 0.5 * (inside[0] + 1.0), offset)
    low, high = (jnp.asarray(ends, choice.dtype) for ends in (ACTION_LOW, ACTION_HIGH))
    return LoadingPlan(pose, action_from(low + 0.5 * (inside[2:] + 1.0) * (high - low)))


def observe(state: State) -> Observation:
    """What an agent sees of a state."""
    course, pile, done = state.course, state.standing.pile, state.standing.done
    sizes = jnp.asarray(pile.height.shape, pile.height.dtype)
    middle = pile.origin + 0.5 * (sizes - 1.0) * pile.cell_size
    places = (jnp.arange(PLACES, dtype=pile.height.dtype) + 0.5) / PLACES
    straight = jnp.zeros((), pile.height.dtype)
    along = jax.vmap(lambda place: pose_at(course.toe, pile, place, straight))(places)

    def seen(pose: Any) -> Array:
        ends = jnp.cos(pose.heading), jnp.sin(pose.heading)
        return jnp.stack([pose.x - middle[0], pose.y - middle[1], *ends], axis=-1)

    receiver = course.site.placed_receiver
    truck = Pose(*(jnp.asarray(v, pile.height.dtype) for v in jax.tree.leaves(receiver)))
    counts = (done.loads, done.mass, done.trucks, done.aboard)
    return Observation(
        height=jnp.maximum(pile.height - pile.floor, 0.0),
        toe=seen(along),
        truck=seen(truck),
        done=jnp.stack([jnp.asarray(count, pile.height.dtype) for count in counts]),
        missing=course.amount.missing(done)[None],
    )


def _job(episodes: Episodes, course: Course) -> Job:
    return Job(
        world=episodes.world,
        pile=course.pile,
        site=course.site,
        objective=episodes.objective,
        yard=course.yard,
        amount=course.amount,
        toe=course.toe,
    )


def _toe(job: Job) -> Toe:
    assert job.toe is not None
    return job.toe


def _grown(pile: Pile, shape: tuple[int, ...]) -> Pile:
    """A pile in the middle of a larger map, whose other cells the scan did not see."""
    low = [(want - got) // 2 for want, got in zip(shape, pile.height.shape, strict=True)]
    sizes = zip(shape, pile.height.shape, low, strict=True)
    width = [(before, want - got - before) for want, got, before in sizes]
    ground = np.pad(np.asarray(pile.floor), width, mode="edge")
    above = np.pad(np.asarray(pile.height - pile.floor), width)
    valid = np.ones(pile.height.shape, bool) if pile.valid is None else np.asarray(pile.valid)
    origin = np.asarray(pile.origin) - pile.cell_size * np.asarray(low, pile.height.dtype)
    return Pile(
        height=jnp.asarray(ground + above, pile.height.dtype),
        cell_size=pile.cell_size,
        origin=jnp.asarray(origin, pile.height.dtype),
        ground=jnp.asarray(ground, pile.height.dtype),
        valid=jnp.asarray(np.pad(valid, width)),
    )


def _lengthened(toe: Toe, points: int) -> Toe:
    """A toe with its last point repeated, as the shorter ones are."""
    width = ((0, points - len(toe.points)), (0, 0))
    return toe.replace(
        points=jnp.pad(toe.points, width, mode="edge"),
        direction=jnp.pad(toe.direction, width, mode="edge"),
    )
