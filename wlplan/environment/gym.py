"""Episodes of loading as gymnasium has environments: one at a time, or many at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from wlplan.environment.episodes import (
    CHOICES,
    PLACES,
    Episodes,
    Observation,
    State,
    Stepped,
    begin,
    make_episodes,
    seed_piles,
    step,
)
from wlplan.errors import InputError
from wlplan.planning.amounts import Amount, Loads
from wlplan.planning.objective import Objective
from wlplan.site.site import Site
from wlplan.types import Pile, Pose, World
from wlplan.worlds.shipped import load_world

# What an observation stays within: heights of a pile and places on a site [m], counts and tonnes.
_HIGHEST, _FARTHEST, _MOST = 100.0, 10_000.0, 1e6
# From where an arrow begins to the dig that it points to [m].
_ARROW = 5.0

Observed = dict[str, np.ndarray]


class LoadingEnv(gymnasium.Env[Observed, np.ndarray]):
    """A wheel loader at a pile; each step is one loading, with the way to the truck and back.

    Actions are the six numbers of `wlplan.environment.episodes.step`, observations the fields of
    `Observation`. The reward is minus the cost of the loading for the objective.

    Args:
        world: Name of a world, or a world.
        piles: To load from, or how many seed piles; an episode begins on one of them.
        loads: Loads of an episode, if no amount is given.
        amount: To be loaded; an episode terminates once it is.
        objective: As for `wlplan.play`.
        site: Likewise.
        limit: Loads after which an episode is cut off, see `make_episodes`.
        pile_seed: Seed of the seed piles.
        render_mode: "rgb_array", or None.

    Raises:
        InputError: If one of them cannot be used.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        world: str | World = "hybrid",
        *,
        piles: int | Sequence[Pile] = 6,
        loads: int = 10,
        amount: Amount | None = None,
        objective: str | Objective | Mapping[str, Any] | Callable[..., Any] | None = None,
        site: Site | None = None,
        limit: int | None = None,
        pile_seed: int = 0,
        render_mode: str | None = None,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"unknown render mode {render_mode!r}: there is rgb_array.")
        self.render_mode = render_mode
        self.episodes = _episodes(world, piles, loads, amount, objective, site, limit, pile_seed)
        self.observation_space, self.action_space = _spaces(self.episodes)
        self._state: State | None = None
        self._dug: Pose | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Of the choice of piles, from here on.
            options: "pile": number of the pile to begin on, from 0.

        Raises:
            InputError: If there is no such pile.
        """
        super().reset(seed=seed)
        number = _number_of(options, self.episodes)
        if number is None:
            number = int(self.np_random.integers(self.episodes.count))
        self._state, observation = begin(self.episodes, number)
        self._dug = None
        return _observed(observation), {"pile": number}

    def step(self, action: np.ndarray) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Makes a loading.

        Raises:
            InputError: If no episode has begun.
        """
        if self._state is None:
            raise InputError("no episode has begun: call reset first.")
        done = step(self.episodes, self._state, jnp.asarray(action, jnp.float32))
        self._state, self._dug = done.state, done.loading.plan.pose
        info = {name: value.item() for name, value in _facts(done).items()}
        observation = _observed(done.observation)
        return observation, float(done.reward), bool(done.terminated), bool(done.truncated), info

    def render(self) -> np.ndarray | None:
        """The pile as it is with the truck and the last dig, as pixels; None without a mode."""
        if self.render_mode is None or self._state is None:
            return None
        return _picture(self._state, self._dug)


class LoadingVectorEnv(VectorEnv[Observed, np.ndarray, np.ndarray]):
    """Many loaders at piles of their own, stepped as one; arguments as for `LoadingEnv`.

    What has ended begins anew in the step after, which counts nothing.

    Args:
        num_envs: How many.
        world: As of `LoadingEnv`.
        piles: Likewise.
        loads: Likewise.
        amount: Likewise.
        objective: Likewise.
        site: Likewise.
        limit: Likewise.
        pile_seed: Likewise.

    Raises:
        InputError: If one of them cannot be used.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        world: str | World = "hybrid",
        *,
        piles: int | Sequence[Pile] = 6,
        loads: int = 10,
        amount: Amount | None = None,
        objective: str | Objective | Mapping[str, Any] | Callable[..., Any] | None = None,
        site: Site | None = None,
        limit: int | None = None,
        pile_seed: int = 0,
    ):
        if num_envs < 1:
            raise InputError(f"{num_envs} environments make no sense: ask for at least 1.")
        self.num_envs = num_envs
        self.render_mode = None
        self.episodes = _episodes(world, piles, loads, amount, objective, site, limit, pile_seed)
        self.single_observation_space, self.single_action_space = _spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._states: State | None = None
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begins an episode in each; arguments as for one."""
        super().reset(seed=seed)
        number = _number_of(options, self.episodes)
        numbers = np.full(self.num_envs, number) if number is not None else self._numbers()
        self._states, observation = _begin_all(self.episodes, jnp.asarray(numbers))
        self._ended = np.zeros(self.num_envs, bool)
        return _observed(observation), {"pile": numbers}

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observed, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Makes a loading in each that has not ended.

        Raises:
            InputError: If no episode has begun.
        """
        if self._states is None:
            raise InputError("no episode has begun: call reset first.")
        done = _step_all(
            self.episodes,
            self._states,
            jnp.asarray(actions, jnp.float32),
            jnp.asarray(self._ended),
            jnp.asarray(self._numbers()),
        )
        self._states = done.state
        terminated, truncated = np.asarray(done.terminated), np.asarray(done.truncated)
        self._ended = terminated | truncated
        reward = np.asarray(done.reward, np.float64)
        return _observed(done.observation), reward, terminated, truncated, _facts(done)

    def _numbers(self) -> np.ndarray:
        """A course for each."""
        return self.np_random.integers(self.episodes.count, size=self.num_envs, dtype=np.int32)


@jax.jit
def _begin_all(episodes: Episodes, numbers: jax.Array) -> tuple[State, Observation]:
    return jax.vmap(lambda number: begin(episodes, number))(numbers)


@jax.jit
def _step_all(
    episodes: Episodes, states: State, actions: jax.Array, ended: jax.Array, numbers: jax.Array
) -> Stepped:
    def one(state: State, action: jax.Array, ended: jax.Array, number: jax.Array) -> Stepped:
        stepped = step(episodes, state, action)
        anew, seen = begin(episodes, number)

        def chosen(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(ended, a, b), new, old)

        still = ~ended
        return stepped.replace(
            state=chosen(anew, stepped.state),
            observation=chosen(seen, stepped.observation),
            reward=jnp.where(ended, 0.0, stepped.reward),
            terminated=stepped.terminated & still,
            truncated=stepped.truncated & still,
        )

    stepped: Stepped = jax.vmap(one)(states, actions, ended, numbers)
    return stepped


def _episodes(
    world: str | World,
    piles: int | Sequence[Pile],
    loads: int,
    amount: Amount | None,
    objective: Any,
    site: Site | None,
    limit: int | None,
    pile_seed: int,
) -> Episodes:
    where = Site() if site is None else site
    if isinstance(world, str):
        world = load_world(world, soil=where.soil, machine=where.machine)
    if isinstance(piles, int):
        piles = seed_piles(piles, seed=pile_seed)
    return make_episodes(
        world,
        piles,
        amount=Loads(loads) if amount is None else amount,
        objective=objective,
        site=site,
        limit=limit,
    )


def _spaces(episodes: Episodes) -> tuple[Any, spaces.Box]:
    def box(low: float, high: float, *shape: int) -> spaces.Box:
        return spaces.Box(low, high, shape, np.float32)

    seen = spaces.Dict(
        {
            "height": box(0.0, _HIGHEST, *episodes.courses.pile.height.shape[1:]),
            "toe": box(-_FARTHEST, _FARTHEST, PLACES, 4),
            "truck": box(-_FARTHEST, _FARTHEST, 4),
            "done": box(0.0, _MOST, 4),
            "missing": box(0.0, _MOST, 1),
        }
    )
    return seen, box(-1.0, 1.0, CHOICES)


def _observed(observation: Observation) -> Observed:
    names = ("height", "toe", "truck", "done", "missing")
    return {name: np.asarray(getattr(observation, name), np.float32) for name in names}


def _facts(done: Stepped) -> dict[str, np.ndarray]:
    """What is worth knowing of a step beside the reward."""
    loading = done.loading
    found = {
        "cost": loading.cost,
        "mass": loading.performance.mass,
        "time": loading.performance.time,
        "work": loading.performance.work,
        "transport_time": loading.transport.time,
        "touching": loading.transport.touching,
        "x": loading.plan.pose.x,
        "y": loading.plan.pose.y,
        "heading": loading.plan.pose.heading,
    }
    return {name: np.asarray(value) for name, value in found.items()}


def _number_of(options: dict[str, Any] | None, episodes: Episodes) -> int | None:
    number = (options or {}).get("pile")
    if number is not None and number not in range(episodes.count):
        raise InputError(f"there is no pile {number!r}: there are {episodes.count}, from 0.")
    return None if number is None else int(number)


def _picture(state: State, dug: Pose | None) -> np.ndarray:
    """A map of a state as pixels."""
    # Drawing is slow to import, and most who learn never look.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import Normalize

    from wlplan.report.figures.relief import (
        PILE,
        draw_pile,
        draw_toe,
        grow_to_ratio,
        height_above_ground,
        view_of,
    )
    from wlplan.report.figures.style import BLUE, add_arrow, frame_map, map_panels
    from wlplan.report.figures.truck import Truck, draw_truck
    from wlplan.site.frame import LOCAL

    before, pile = state.course.pile, state.standing.pile
    truck = Truck(state.course.site.placed_receiver)
    view = grow_to_ratio(view_of(before, truck.body))
    figure, (panel,) = map_panels(view, 1)
    norm = Normalize(0.0, max(float(height_above_ground(before).max()), 0.1))
    draw_pile(panel, pile, PILE, norm)
    loads = int(state.standing.done.loads)
    frame_map(panel, view, f"After {loads} load{'' if loads == 1 else 's'}", LOCAL)
    draw_toe(panel, before, "dashed")
    draw_truck(panel, truck, view)
    if dug is not None:
        x, y, heading = (float(v) for v in (dug.x, dug.y, dug.heading))
        tip = np.array([x, y])
        ahead = np.array([math.cos(heading), math.sin(heading)])
        add_arrow(panel, tip - _ARROW * ahead, tip, colour=BLUE, line=2.0, head=12.0, zorder=8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
