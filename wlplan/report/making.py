"""From a pile and what is asked for to a plan that was played, and all that shows it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float

from wlplan.planning import plan as planning
from wlplan.planning.amounts import Amount
from wlplan.planning.named import NamedPile, NamedSite, Note, unsaid
from wlplan.planning.objective import objective_of
from wlplan.planning.piles import heights_after
from wlplan.planning.playing import PlanResult
from wlplan.planning.proposals import Planner
from wlplan.report.document import plan_document, violations_of, write_plan_folder
from wlplan.site.site import Site
from wlplan.types import Pile, World

Timed = Callable[[str], contextlib.AbstractContextManager[object]]
"""A block of this name is timed: "planning", or "simulator" for playing the plan."""


@runtime_checkable
class Told(Protocol):
    """Is told what begins, and how far a stage is, as `wlplan.planning.proposals.Progress`."""

    def phase(self, text: str) -> None:
        """What begins, in words."""

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        """How far a stage is."""


@dataclasses.dataclass(frozen=True)
class Asked:
    """What is asked for.

    Attributes:
        amount: To be loaded.
        truck: x [m] and y [m] in the coordinates of the scan and, if given, heading [degree];
            "auto" or "each", see `plan_loads`; None for the default place.
        planner: By name, or a value.
        objective: By name, or a value.
        names: What plan.json says of `world`, `planner`, `objective` and models of one's own.
        referee: Whether the simulator picks among the planner's best plans.
        seed: Of everything random.
    """

    amount: Amount
    truck: tuple[float, ...] | str | None
    planner: str | Planner
    objective: Any
    names: Mapping[str, Any]
    referee: bool = True
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class MadePlan:
    """A plan that was made and played.

    Attributes:
        document: Content of its plan.json.
        pile: Before the first load.
        planned: As the planning world has it.
        simulated: As the simulator played it.
        site: With its receiver.
        simulator: That played it.
        violated: The loads, counted from 1, that violate each constraint that is violated.
    """

    document: dict[str, Any]
    pile: Pile
    planned: PlanResult
    simulated: PlanResult
    site: Site
    simulator: World
    violated: dict[str, list[int]]

    @functools.cached_property
    def heights(self) -> Float[np.ndarray, "n nx ny"]:
        """As each load leaves them in the simulator [m]; it plays the plan once more."""
        return heights_after(self.simulator, self.pile, self.simulated.plan)

    def write(
        self, folder: Path, *, settings: Mapping[str, str], also: Sequence[str] = ()
    ) -> list[str]:
        """Writes what shows it, see `write_plan_folder`."""
        return write_plan_folder(
            folder,
            self.document,
            self.pile,
            self.simulated,
            site=self.site,
            predicted=self.planned.rollout.performance,
            heights=self.heights,
            settings=settings,
            also=also,
        )


def make_plan(
    named: NamedPile,
    site: NamedSite,
    world: World,
    simulator: World,
    asked: Asked,
    *,
    progress: Told,
    stop: Callable[[], bool] | None = None,
    timed: Timed = contextlib.nullcontext,
    note: Note = unsaid,
) -> MadePlan:
    """Plans, plays the plan in the simulator, and lays both out.

    Args:
        named: The pile.
        site: What is dug and what digs.
        world: To plan in.
        simulator: To play in, and the referee where one is asked for. If it is what `world` is
            named after, the plan is played there already.
        asked: What is asked for.
        progress: Told how far it is.
        stop: As of `plan_loads`.
        timed: Times the parts.
        note: Told what is worth knowing but no error.

    Raises:
        InputError: As `plan_loads`.
        KeyboardInterrupt: If it was stopped before there was a plan.
    """
    goal = objective_of(asked.objective)
    in_simulator = asked.names["world"] == "simulator"
    at = asked.truck
    progress.phase("placing the truck")
    place = site.with_receiver(named, at if isinstance(at, tuple) else None, note=note)
    progress.phase("planning")
    with timed("planning"):
        planned = jax.block_until_ready(
            planning.plan_loads(
                world,
                named.pile,
                amount=asked.amount,
                objective=goal,
                planner=asked.planner,
                site=place,
                truck=at if isinstance(at, str) else None,
                seed=asked.seed,
                referee=simulator if asked.referee and not in_simulator else None,
                progress=progress,
                stop=stop,
                contour=named.contour,
            )
        )
    place = place.replace(receiver=planned.receiver)
    simulated = planned.refereed or planned
    if planned.refereed is None and not in_simulator:
        progress.phase("playing the plan in the simulator")
        with timed("simulator"):
            simulated = jax.block_until_ready(
                planning.play(
                    simulator,
                    named.pile,
                    planned.plan,
                    objective=goal,
                    amount=asked.amount,
                    site=place,
                )
            )
    document = plan_document(
        named.pile,
        simulated,
        site=place,
        predicted=planned.rollout.performance,
        predicted_cost=float(planned.cost),
        deviation=planned.deviation,
        stall_probability=planned.stall_probability,
        amount=asked.amount,
        stopped=planned.stopped,
        seen=getattr(world, "faces_seen", None),
        pile=named.fields,
        **site.fields(),
        **asked.names,
        referee=asked.referee,
        seed=asked.seed,
    )
    violated = violations_of(planned, goal.constraints)
    return MadePlan(document, named.pile, planned, simulated, place, simulator, violated)
