"""A service in this process, asked as any program would ask it; the planner is played by a fake."""

import contextlib
import dataclasses
import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cones import bowl_world

from wlplan.planning import plan as planning
from wlplan.planning.loading import Transport
from wlplan.planning.named import NamedSite
from wlplan.planning.playing import PlanResult
from wlplan.serve import server
from wlplan.serve.app import make_app
from wlplan.serve.service import Named, Service, Worlds
from wlplan.site.site import Site
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose, Rollout, World

MOST_BYTES = 2**20


@dataclasses.dataclass
class Answer:
    """What came back."""

    status: int
    headers: dict[str, str]
    content: bytes

    def json(self) -> Any:
        """As JSON without NaN."""
        return json.loads(self.content, parse_constant=lambda text: 1 / 0)

    @property
    def error(self) -> str:
        """The one line of a refusal."""
        found = self.json()
        assert list(found) == ["error"]
        assert "\n" not in found["error"]
        return str(found["error"])


class Served:
    """A service that answers."""

    def __init__(self, service: Service, port: int, lines: list[str]):
        self.service, self.port, self.lines = service, port, lines

    def connection(self) -> http.client.HTTPConnection:
        """To be closed by whoever asked for it."""
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        """One request; values that are no bytes are sent as JSON, `_` of headers stands for `-`."""
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        if body is not None and not isinstance(body, bytes):
            body, sent = json.dumps(body).encode(), {"Content-Type": "application/json"} | sent
        with contextlib.closing(self.connection()) as connection:
            connection.request(method, path, body, sent)
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, found, answer.read())

    def until(self, job: str, state: str) -> Any:
        """What is known of a job once it is in a state."""
        for _ in range(1000):
            found = self.ask("GET", f"/jobs/{job}").json()
            if found["state"] == state:
                return found
            time.sleep(0.05)
        raise AssertionError(f"{found} and never {state}")


@contextlib.contextmanager
def serving(world: World = bowl_world, planner: Any = "greedy") -> Iterator[Served]:
    """A service that plans in a world of closed form, and plays there too."""
    service = Service(
        NamedSite(),
        Worlds(lambda name: world, ("bowl", "other")),
        lambda: world,
        Named("quick", planner),
        most_bytes=MOST_BYTES,
    )
    lines: list[str] = []
    taken = server.bound("127.0.0.1", 0)
    running = server.made(make_app(service, log=lines.append))
    thread = threading.Thread(target=running.run, args=([taken],), daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    try:
        yield Served(service, taken.getsockname()[1], lines)
    finally:
        service.desk.close()
        running.should_exit = True
        thread.join(10.0)
        taken.close()


class FakePlanner:
    """Digs at even distances; may take until it is stopped.

    Attributes:
        calls: Arguments of the calls, in order.
        waits: Whether it goes on until it is stopped, or `go` is set.
    """

    def __init__(self) -> None:
        self.calls: list[dict[str, Any]] = []
        self.waits, self.go = False, threading.Event()

    def plan_loads(
        self,
        world: World,
        pile: Pile,
        *,
        amount: Any,
        progress: Callable[..., None],
        stop: Callable[[], bool],
        site: Site,
        **options: Any,
    ) -> PlanResult:
        """As that of the package."""
        self.calls.append({"amount": amount, "site": site, **options})
        count = 2
        pose = edge_poses(toe_contour(pile), count)
        plan = LoadingPlan(
            Pose(*(jnp.asarray(v, jnp.float32) for v in (pose.x, pose.y, pose.heading))),
            Action(*(jnp.full(count, value) for value in (0.5, 2.0, 0.5, 2.0))),
        )
        progress("steps", 1, count, 3.0)
        while self.waits and not stop() and not self.go.is_set():
            time.sleep(0.01)
        made = self.play(world, pile, plan, site=site)
        return made.replace(stopped="interrupted") if stop() else made

    def play(
        self, world: World, pile: Pile, plan: LoadingPlan, *, site: Site, **_: Any
    ) -> PlanResult:
        """As that of the package."""
        count = len(plan.pose.x)
        mass = jnp.full(count, 2.0)
        height = np.asarray(pile.height, np.float64)
        lost = float(mass.sum()) / (site.soil.density / 1000.0) / pile.cell_size**2
        after = pile.replace(height=jnp.asarray(height - lost * height / height.sum(), jnp.float32))
        performance = Performance(mass, jnp.full(count, 10.0), jnp.full(count, 300.0))
        return PlanResult(
            plan=plan,
            rollout=Rollout(performance, after),
            transport=Transport(jnp.full(count, 20.0), jnp.full(count, 100.0)),
            terms={},
            receiver=site.receiver,
            costs=jnp.full(count, 1.0),
            cost=jnp.asarray(float(count)),
        )


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakePlanner:
    """Takes the place of the planner."""
    one = FakePlanner()
    monkeypatch.setattr(planning, "plan_loads", one.plan_loads)
    monkeypatch.setattr(planning, "play", one.play)
    return one
