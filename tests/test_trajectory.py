"""The recorded motion of a loading: that of `dig`, in order, from the approach to the stop."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.engines.simulator import STOP_REASONS, Section, Settings, dig, trace, trace_section
from wlplan.engines.simulator.cycle import Cycle
from wlplan.engines.simulator.trajectory import Trajectory
from wlplan.site.machine import WA320
from wlplan.site.soil import GRAVEL
from wlplan.terrain.heightmap import local_axes
from wlplan.types import action_from

ALONG, _ = local_axes(52, 1.0)
# Actions that end by the tilt, by penetration or breakout, and at the time limit.
ACTIONS = np.array(
    [[0.7, 0.0, 0.0, 5.0], [0.1, 1.0, 0.1, 2.5], [0.0, 5.0, 0.7, 0.0], [0.7, 0.0, 0.7, 0.0]],
    np.float32,
)
SLOPE = np.tan(math.radians(30.0))
HEIGHT = jnp.asarray(np.tile(np.clip(SLOPE * ALONG[:, None], 0.0, 4.0), 52), jnp.float32)


def played(function: Callable[..., Any]) -> Any:
    """A function of surface, floor and action on all the actions."""

    @jax.jit
    @jax.vmap
    def play(action: jax.Array) -> Any:
        return function(HEIGHT, jnp.zeros_like(HEIGHT), action_from(action))

    return jax.tree.map(np.asarray, play(jnp.asarray(ACTIONS)))


@pytest.fixture(scope="module")
def both() -> tuple[Cycle, Trajectory]:
    return played(dig), played(trace)


def test_it_ends_where_the_cycle_does(both: tuple[Cycle, Trajectory]) -> None:
    cycle, trajectory = both
    assert len(set(cycle.stop_reason.tolist())) > 1
    assert (trajectory.phase[:, -1] == 2).all()
    np.testing.assert_allclose(trajectory.mass[:, -1], cycle.mass, rtol=1e-4)
    np.testing.assert_allclose(trajectory.tilt[:, -1], WA320.tilt_end, atol=1e-3)
    assert (trajectory.time[:, -1] < cycle.time).all()
    for k in range(len(ACTIONS)):
        # The first moment after the filling is that of the stop.
        stop = int(np.argmax(trajectory.phase[k] >= 1))
        place = trajectory.tip_x[k, stop], trajectory.tip_z[k, stop]
        np.testing.assert_allclose(place, (cycle.tip_x[k], cycle.tip_z[k]), atol=1e-4)
    assert STOP_REASONS[int(cycle.stop_reason[0])] == "tilt_end"


def test_it_begins_a_metre_before_the_pile_with_an_empty_bucket_on_the_ground(
    both: tuple[Cycle, Trajectory],
) -> None:
    _, trajectory = both
    np.testing.assert_allclose(trajectory.tip_x[:, 0], -1.0, atol=1e-6)
    np.testing.assert_allclose(trajectory.tip_z[:, 0], 0.0, atol=1e-6)
    np.testing.assert_array_equal(trajectory.mass[:, 0], 0.0)
    np.testing.assert_allclose(trajectory.speed[:, 0], WA320.travel_speed)


def test_time_and_position_go_on_step_by_step_and_the_end_repeats(
    both: tuple[Cycle, Trajectory],
) -> None:
    _, trajectory = both
    steps = np.diff(trajectory.time, axis=1)
    assert (steps >= 0.0).all()
    assert steps.max() <= Settings().step + 1e-5
    moving = trajectory.phase[:, 1:] < 2
    assert (steps[moving] > 0.0).all()
    assert trajectory.time.shape == (len(ACTIONS), Settings().max_steps + 1)
    for k in range(len(ACTIONS)):
        ended = trajectory.phase[k] == 2
        assert np.ptp(trajectory.tip_x[k][ended]) == 0.0
        assert (np.diff(trajectory.phase[k]) >= 0).all()
    assert (np.diff(trajectory.mass, axis=1) > -1.0).all()


def test_a_batch_equals_its_members(both: tuple[Cycle, Trajectory]) -> None:
    _, trajectory = both
    alone = jax.jit(trace)(HEIGHT, jnp.zeros_like(HEIGHT), action_from(jnp.asarray(ACTIONS[1])))
    for one, all_ in zip(jax.tree.leaves(alone), jax.tree.leaves(trajectory), strict=True):
        np.testing.assert_allclose(one, all_[1], rtol=1e-4, atol=1e-3)


@pytest.fixture(scope="module")
def sections() -> tuple[Trajectory, Section]:
    both: tuple[Trajectory, Section] = played(trace_section)
    return both


def test_the_section_is_of_the_same_motion_and_ends_as_the_cycle_leaves_the_soil(
    both: tuple[Cycle, Trajectory], sections: tuple[Trajectory, Section]
) -> None:
    cycle, trajectory = both
    path, section = sections
    np.testing.assert_allclose(path.tip_x, trajectory.tip_x, atol=1e-4)
    middle = np.asarray(cycle.height)[:, :, 25:27].mean(axis=-1)
    np.testing.assert_allclose(section.surface[:, -1], middle, atol=2e-3)
    before = np.broadcast_to(np.asarray(HEIGHT)[:, 25], section.surface[:, 0].shape)
    np.testing.assert_allclose(section.surface[:, 0], before, atol=1e-6)
    # The surface is dug in the middle, and not where the bucket did not come.
    assert (section.surface[:, -1] - before).min() < -0.2


def test_what_lies_in_the_middle_of_the_bucket_is_of_the_order_of_the_mean(
    sections: tuple[Trajectory, Section],
) -> None:
    path, section = sections
    np.testing.assert_array_equal(section.content[:, 0], 0.0)
    mean = path.mass / GRAVEL.density / WA320.bucket_width
    loaded = path.mass[:, -1] > 500.0
    assert loaded.any()
    ratio = section.content[loaded, -1] / mean[loaded, -1]
    assert (ratio > 0.95).all()
    assert (ratio < 1.6).all()
