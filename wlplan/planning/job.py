"""What every planner works on: a job, where it stands, and decisions for N loadings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from wlplan.actions import squash
from wlplan.checks import check_pile, check_world
from wlplan.errors import InputError
from wlplan.planning.amounts import Amount, Done, Loads, check_amount, nothing_done
from wlplan.planning.objective import Objective, objective_of
from wlplan.planning.placement import beside
from wlplan.planning.poses import Toe, pose_at, toe_of
from wlplan.planning.yard import Yard, yard_of
from wlplan.site.frame import LOCAL
from wlplan.site.receiver import receiver_count
from wlplan.site.site import Site
from wlplan.terrain.toe import ToeContour, toe_contour
from wlplan.types import Action, LoadingPlan, Pile, Pose, World
from wlplan.worlds.capabilities import FORESIGHT, as_pytree, can, is_differentiable
from wlplan.xla import on_device

# As many loads as a plan has rows.
_AS_GIVEN = Loads(2**30)


@no_type_check
class Job(struct.PyTreeNode):
    """What is asked for: a pile to load from at a site, for an objective, as a world sees it."""

    world: World
    pile: Pile
    site: Site  # with its receiver
    objective: Objective = struct.field(pytree_node=False)
    yard: Yard  # room to drive around the pile
    amount: Amount  # to be loaded
    toe: Toe | None = None  # to dig along; None where plans with poses of their own are played
    # Who plays each load as it is planned, for planners that ask for it; None: the world itself.
    referee: World | None = None


def judged(job: Job) -> Job:
    """The job in the world of its referee, if it has one."""
    return job if job.referee is None else job.replace(world=job.referee, referee=None)


@no_type_check
class Standing(struct.PyTreeNode):
    """Where a job stands."""

    pile: Pile  # as it is by now
    done: Done  # of the amount


def beginning(job: Job) -> Standing:
    """Before the first load."""
    return Standing(job.pile, nothing_done(job.pile.height.dtype))


def make_job(
    world: World,
    pile: Pile,
    *,
    site: Site | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
    amount: Amount = _AS_GIVEN,
    contour: ToeContour | None = None,
) -> Job:
    """A job without a toe, once everything that users get wrong was looked at.

    Args:
        world: World to plan or play in.
        pile: The pile before the first loading.
        site: Machine, soil and receiver; default: the WA320 in gravel. Without a receiver it has
            one beside the pile.
        objective: A name, an `Objective`, named terms, or a function of a loading.
        amount: To be loaded; by default the loads of whatever plan is played.
        contour: Toe of the pile where it is known already.

    Raises:
        InputError: If one of them cannot be used; one line that says what to do.
    """
    check_world(world)
    check_pile(pile)
    check_amount(amount)
    placed = beside(Site() if site is None else site, pile, contour)
    return Job(
        world=as_pytree(world),
        pile=pile,
        # Nothing that is computed depends on the frame: what is compiled serves all of them. What
        # is closed to traffic is part of the yard; the truck has its place.
        site=placed.replace(frame=LOCAL, keep_out=None, truck_area=None),
        objective=objective_of(objective),
        yard=yard_of(pile, placed.machine, placed.keep_out),
        amount=amount,
    )


def with_toe(job: Job, contour: ToeContour | None = None) -> Job:
    """The job with a toe to dig along.

    Args:
        job: Any job.
        contour: Toe of its pile where it is known already; by default it is traced.

    Raises:
        InputError: If there is nothing to dig, a bucket can start nowhere, or each truck has a
            place of its own: plans are made for one.
    """
    if receiver_count(job.site.placed_receiver):
        raise InputError(
            "the site has a receiver for each of several trucks: plan with one, or leave the "
            "places to the planner."
        )
    if contour is None:
        contour = toe_contour(job.pile, machine=job.site.machine)
    return job.replace(toe=toe_of(contour, job.site.machine, job.pile.height.dtype))


@no_type_check
class Decisions(struct.PyTreeNode):
    """What a planner chooses of loadings; unbounded, so that any value is a plan."""

    position: Float[Array, "*n"]  # along the toe contour, in parts of its length
    offset: Float[Array, "*n"]  # heading offset before squashing
    action: Float[Array, "*n 4"]  # action parameters before squashing
    truck: Int[Array, "*n"] | None = None  # as of a `LoadingPlan`


def decided(job: Job, standing: Standing, one: Decisions | LoadingPlan) -> LoadingPlan:
    """Pose and action of one loading on the pile as it is, and the truck that it goes to.

    Args:
        job: With its toe, for decisions.
        standing: Before the loading.
        one: Decisions, or a loading with a pose of its own. If it does not say whether it is made,
            it is until the amount is done; of a number of loads all are.
    """
    if isinstance(one, Decisions):
        assert job.toe is not None
        pose = pose_at(job.toe, standing.pile, one.position, one.offset)
        plan = LoadingPlan(pose, squash(one.action), one.truck)
    else:
        plan = one
    if plan.truck is None and not isinstance(job.amount, Loads):
        done = standing.done
        plan = plan.replace(truck=jnp.where(job.amount.is_done(done), -1, done.trucks))
    return plan


def contour_length(job: Job) -> Float[Array, ""]:
    """Length of the toe contour [m]."""
    assert job.toe is not None
    length: Array = _length(job.toe.points)
    return length


@jax.jit
def _length(points: Float[Array, "n 2"]) -> Float[Array, ""]:
    steps = points[1:] - points[:-1]
    return jnp.sqrt((steps**2).sum(axis=1)).sum()


def stacked(decisions: Sequence[Decisions]) -> Decisions:
    """Several decisions as one, with a new leading axis; by numpy, which compiles nothing."""
    together: Decisions = jax.tree.map(lambda *leaves: on_device(np.stack(leaves)), *decisions)
    return together


def check_has_gradient(job: Job, remedy: str) -> None:
    """Refuses a job in a world without a derivative, before JAX does.

    Args:
        job: Any job.
        remedy: What to do about it, in words that follow a colon.

    Raises:
        InputError: If the world says that it has none, or says nothing and has none.
    """
    said = is_differentiable(job.world)
    if said is None:
        said = _passes_reverse_mode(job)
    if not said:
        raise InputError(f"this world has no derivative: {remedy}.")


def check_knows_enough(job: Job) -> None:
    """Refuses to plan for what the world does not know; to play a plan it need not.

    Raises:
        InputError: If a term of the objective needs it.
    """
    for name, need in job.objective.needs.items():
        if not can(job.world, need):
            raise InputError(
                f"the term {name!r} needs a world that knows {FORESIGHT[need]}: plan in a learned "
                f"world that does, or leave the term out."
            )


def can_refine(job: Job, steps: int) -> bool:
    """Whether a planner that may refine by gradient, in so many steps, is to do so.

    Args:
        job: Any job.
        steps: Steps that it would make; 0 for none.

    Raises:
        InputError: If the world does not say whether it has a derivative, and has none.
    """
    if steps == 0 or is_differentiable(job.world) is False:
        return False
    check_has_gradient(job, "declare that with wlplan.world(function, differentiable=False)")
    return True


def _passes_reverse_mode(job: Job) -> bool:
    """Whether a function that does not say so has a derivative, found by tracing it."""
    number = jnp.zeros((), job.pile.height.dtype)
    pose, action = Pose(number, number, number), Action(number, number, number, number)

    def mass(pose: Pose, action: Action) -> Array:
        return job.world(job.pile, pose, action)[1].mass

    # What is wrong with the function itself is for its author to see, as it is.
    jax.eval_shape(mass, pose, action)
    try:
        jax.eval_shape(jax.grad(mass, argnums=(0, 1)), pose, action)
    except Exception:
        return False
    return True


def padded(chosen: Sequence[Decisions], rows: int) -> Decisions:
    """Loadings in order, with their trucks, as a plan of so many rows; the rest is not made."""
    plan = stacked(chosen)
    at = np.minimum(np.arange(rows), len(chosen) - 1)
    full: Decisions = jax.tree.map(lambda leaf: leaf[at], plan)
    assert full.truck is not None
    trucks = np.where(np.arange(rows) < len(chosen), full.truck, -1).astype(np.int32)
    return full.replace(truck=trucks)
