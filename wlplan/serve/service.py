"""What the endpoints work with: worlds that are loaded, scans, plans, and the desk."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from wlplan.planning import planners
from wlplan.planning.named import NamedPile, NamedSite, read_named
from wlplan.report import exports
from wlplan.report.making import Asked, MadePlan, make_plan
from wlplan.serve.answers import Refused, document_text
from wlplan.serve.desk import Desk, Job
from wlplan.serve.settings import AREAS, READING, amount_of
from wlplan.serve.uploads import Upload, Uploads, area_file
from wlplan.types import World

# Piles and plans that are kept.
_PILES, _PLANS = 4, 12


@dataclasses.dataclass(frozen=True)
class Named:
    """Something with the name that plan.json gives it."""

    name: str
    value: Any


class Worlds:
    """Worlds by name, each made once.

    Args:
        make: Makes the world of a name.
        names: Those that may be asked for, the default one first.
    """

    def __init__(self, make: Callable[[str], World], names: tuple[str, ...]):
        self._make, self._made, self.names = make, dict[str, World](), names

    def named(self, name: str) -> World:
        """The world of a name."""
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name]


@dataclasses.dataclass(frozen=True)
class KeptPlan:
    """A plan that can be had again.

    Attributes:
        id: Under which.
        made: The plan.
        areas: GeoJSON that the scan was read with, by name.
        seconds: How long its parts took, in words.
    """

    id: str
    made: MadePlan
    areas: Mapping[str, Any]
    seconds: Mapping[str, str]

    @cached_property
    def text(self) -> str:
        """Its plan.json."""
        return document_text(self.made.document)

    @cached_property
    def pages(self) -> dict[str, bytes]:
        """Its page and pictures by the names of their files; takes seconds to draw."""
        with tempfile.TemporaryDirectory(prefix="wlplan-") as folder:
            names = self.made.write(Path(folder), settings=self.seconds)
            return {name: (Path(folder) / name).read_bytes() for name in names}

    def content(self, name: str) -> bytes | None:
        """A file of it by name; None if there is no such file."""
        if name == "plan.json":
            return self.text.encode()
        for area in self.areas:
            if name == area_file(area):
                return json.dumps(self.areas[area]).encode()
        if kind := exports.kind_of(name):
            played = exports.Played(self.made.document, self.made.pile, self.made.heights)
            return exports.exported((kind,), played)[name]
        return self.pages.get(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its files."""
        areas = (area_file(name) for name in self.areas)
        return ("report.html", "plan.json", "plan.png", *exports.file_names(), *areas)


class Service:
    """All of it.

    Args:
        site: What is dug and what digs.
        worlds: That may be planned in; the first is the default.
        simulator: Plays the plans.
        planner: The default one.
        most_bytes: Of a request.
        models: What plan.json says of models that do not ship, of the default world.
    """

    def __init__(
        self,
        site: NamedSite,
        worlds: Worlds,
        simulator: Callable[[], World],
        planner: Named,
        *,
        most_bytes: int,
        models: Mapping[str, str] | None = None,
    ):
        self.site, self.worlds, self._simulator = site, worlds, simulator
        self.most_bytes, self._models = most_bytes, models or {}
        self._planners: dict[str, Any] = {planner.name: planner.value}
        self._planners |= {name: name for name in planners.NAMES if name not in self._planners}
        self.uploads, self.desk = Uploads(most_bytes), Desk()
        self._piles: collections.OrderedDict[str, NamedPile] = collections.OrderedDict()
        self._plans: collections.OrderedDict[str, KeptPlan] = collections.OrderedDict()
        self._lock = threading.Lock()

    @property
    def planners(self) -> tuple[str, ...]:
        """Names of the planners, the default one first."""
        return tuple(self._planners)

    @cached_property
    def simulator(self) -> World:
        """Plays the plans."""
        return self._simulator()

    def world_of(self, settings: Mapping[str, Any]) -> Named:
        """The world that settings name."""
        name = settings.get("world", self.worlds.names[0])
        return Named(name, self.worlds.named(name))

    def pile_of(self, upload: Upload, settings: Mapping[str, Any]) -> NamedPile:
        """The pile of a scan; one that was read lately is not read again.

        Args:
            upload: The scan.
            settings: Those of `READING` and `AREAS` count.

        Raises:
            InputError: If it cannot be read or dug.
        """
        reading, areas = reading_of(settings)
        key = json.dumps([upload.id, reading, areas], sort_keys=True)
        if key not in self._piles:
            with upload.on_disk(areas) as (path, files):
                named = read_named(path, {**reading, **files}, self.site.machine, name=upload.name)
                notes = [upload.shown(note, path.parent) for note in named.fields["notes"]]
            # Beside a plan that is saved, these are the files' names.
            shown = {name: area_file(name) for name in areas}
            fields = {**named.fields, "notes": notes, **shown}
            self._piles[key] = dataclasses.replace(named, fields=fields)
            while len(self._piles) > _PILES:
                self._piles.popitem(last=False)
        self._piles.move_to_end(key)
        return self._piles[key]

    def plan(self, job: Job, upload: Upload, settings: Mapping[str, Any]) -> KeptPlan:
        """Makes a plan and keeps it; in the thread of the desk.

        Args:
            job: Is told how far it is, and may be told to stop.
            upload: The scan.
            settings: Checked ones.

        Raises:
            InputError: If it cannot be made.
            KeyboardInterrupt: If it was stopped before there was one.
        """
        telling = job.telling
        telling.phase(f"reading {upload.name}")
        named = self.pile_of(upload, settings)
        telling.phase("loading the models")
        world, simulator = self.world_of(settings), self.simulator
        amount = amount_of(settings)
        planner = settings.get("planner", self.planners[0])
        objective = settings.get("objective", amount.objective)
        models = self._models if world.name == self.worlds.names[0] else {}
        clock = Clock()
        made = make_plan(
            named,
            self.site,
            world.value,
            simulator,
            Asked(
                amount=amount,
                truck=settings.get("truck"),
                planner=self._planners[planner],
                objective=objective,
                names={
                    "world": world.name,
                    "planner": planner,
                    "objective": objective,
                    **models,
                },
                referee=settings.get("referee", True),
                seed=settings.get("seed", 0),
            ),
            progress=telling,
            stop=job.stopping.is_set,
            timed=clock.part,
        )
        kept = KeptPlan(job.id, made, reading_of(settings)[1], clock.seconds)
        _ = kept.text  # what cannot be told is no plan
        with self._lock:
            self._plans[kept.id] = kept
            while len(self._plans) > _PLANS:
                self._plans.popitem(last=False)
        return kept

    def find_plan(self, name: str) -> KeptPlan:
        """The plan of a name.

        Raises:
            Refused: If it is not kept any more.
        """
        with self._lock:
            if name not in self._plans:
                raise Refused(404, "there is no such plan any more: plan again.")
            return self._plans[name]


def reading_of(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """How a scan is read, and the GeoJSON of its areas."""
    reading = {name: settings[name] for name in READING if name in settings}
    return reading, {name: settings[name] for name in AREAS if name in settings}


class Clock:
    """How long parts took, by name, in words."""

    def __init__(self) -> None:
        self.seconds: dict[str, str] = {}

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """A block that is timed."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[f"{name}, wall clock"] = f"{time.perf_counter() - begin:.1f} s"
