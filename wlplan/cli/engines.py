"""Playing a plan in an engine: all at once in the simulator, load by load in discrete elements."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from wlplan.cli.outputs import remark
from wlplan.cli.progress import ready

if TYPE_CHECKING:
    from wlplan.engines.dem.cycle import CycleRecord
    from wlplan.engines.dem.world import DiscreteElements
    from wlplan.planning.plan import PlanResult
    from wlplan.planning.transport import Receiver
    from wlplan.types import LoadingPlan, Pile, World


def play_in(
    world: World,
    pile: Pile,
    plan: LoadingPlan,
    *,
    objective: str,
    receiver: Receiver,
    progress: Callable[[str, int, int, float | None], None],
) -> tuple[PlanResult, list[dict[str, Any]] | None]:
    """Plays a plan in the simulator or in discrete elements.

    Args:
        world: The engine.
        pile: The pile before the first loading.
        plan: N loadings in order.
        objective: Name of what they cost.
        receiver: Where the loads go.
        progress: Told how far it is.

    Returns:
        What came of it, and what plan.json says of each cycle besides; None for the simulator.
    """
    from wlplan.engines.dem.world import DiscreteElements
    from wlplan.planning.plan import play

    if isinstance(world, DiscreteElements):
        return _load_by_load(
            world, pile, plan, objective=objective, receiver=receiver, progress=progress
        )
    progress("simulator", 0, 1, None)
    played = ready(play(world, pile, plan, objective=objective, receiver=receiver))
    progress("simulator", 1, 1, None)
    return played, None


def _load_by_load(
    world: DiscreteElements,
    pile: Pile,
    plan: LoadingPlan,
    *,
    objective: str,
    receiver: Receiver,
    progress: Callable[[str, int, int, float | None], None],
) -> tuple[PlanResult, list[dict[str, Any]]]:
    import jax
    import jax.numpy as jnp

    from wlplan.engines.dem.process import cache_folder
    from wlplan.engines.dem.world import loads, site_remark
    from wlplan.planning.plan import judge
    from wlplan.types import Rollout

    unfit = site_remark(world.soil)
    if unfit is not None:
        remark(unfit)
    count = len(plan.pose.x)
    remark(
        f"a load takes a minute or more; those that were played are kept in {cache_folder()}, so "
        f"that the same command goes on where it was interrupted"
    )
    progress("elements", 0, count, None)
    after, performances, cycles = pile, [], []
    for after, performance, played in loads(world, pile, plan, remark):  # noqa: B007
        performances.append(performance)
        cycles.append(_fields(played))
        progress("elements", len(cycles), count, None)
    outcome = Rollout(
        performance=jax.tree.map(lambda *leaves: jnp.stack(leaves), *performances),
        pile=after,
    )
    return judge(outcome, pile, plan, objective=objective, receiver=receiver), cycles


def _fields(cycle: CycleRecord) -> dict[str, Any]:
    """What plan.json says of a cycle: SI units, but for the work of the wheels' slip [kJ]."""
    from wlplan.constants import J_PER_KJ

    return {
        "stop_reason": cycle.stop_reason,
        "slip_work": cycle.work_slip / J_PER_KJ,
        "spheres": cycle.spheres,
        "cleared_volume": cycle.cleared,
        "lost_volume": cycle.lost,
    }
