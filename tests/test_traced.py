"""Traces that are kept: used for the same call and no other, never of foreign code."""

import dataclasses
import functools
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cones
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx, struct
from jaxtyping import Array

import wlplan
from wlplan import traced as kept
from wlplan.cli import programs
from wlplan.errors import InputError
from wlplan.planning.amounts import Empty, Loads, Tonnes, Trucks
from wlplan.planning.job import make_job
from wlplan.site.machine import WA320
from wlplan.site.soil import GRAVEL
from wlplan.traced import ENDING, VARIABLE, NamelessError, Traced, name_of, plain, read
from wlplan.types import Performance


class Scaled(struct.PyTreeNode):
    """A pytree with something static in it."""

    value: Any
    factor: float = struct.field(pytree_node=False, default=2.0)


# How often each function was traced.
traces: list[str] = []


def yields(one: Scaled, other: Any = None, *, power: int = 1) -> tuple[Performance, Scaled]:
    """Something of ours comes out, and something static."""
    traces.append("yields")
    value = one.factor * one.value**power + (0.0 if other is None else other.sum())
    return Performance(value, jnp.sin(value), value.astype(int)), one.replace(value=value[::-1])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where traces are kept; what this module defines is known."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    monkeypatch.setattr(kept, "_KNOWN", (*kept._KNOWN, __name__))
    traces.clear()
    return tmp_path


def called(function: Any, *arguments: Any, **named: Any) -> Any:
    """What another process would get, which has traced nothing yet."""
    static = ("power",) if function is yields else ()
    return Traced(function, static)(*arguments, **named)


def test_what_was_traced_is_not_traced_again(folder: Path) -> None:
    one = Scaled(np.linspace(0.1, 2.0, 5, dtype=np.float32))
    first = called(yields, one)
    assert traces == ["yields"]
    again = called(yields, one)
    other = called(yields, one.replace(value=one.value + 1.0))
    assert traces == ["yields"]
    assert len(list(folder.iterdir())) == 1
    assert type(again[1]) is Scaled
    assert again[1].factor == 2.0
    # Else all that is called with it would be compiled anew.
    assert not any(leaf.committed for leaf in jax.tree.leaves(again))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    jax.tree.map(np.testing.assert_array_equal, jax.jit(yields)(one), again)
    np.testing.assert_array_equal(
        other[0].mass, jax.jit(yields)(one.replace(value=one.value + 1.0))[0].mass
    )


@pytest.mark.parametrize(
    "other",
    [
        lambda: ((Scaled(np.ones(4, np.float32)),), {}),
        lambda: ((Scaled(np.ones(3, np.int32)),), {}),
        lambda: ((Scaled(np.ones(3, np.float32), factor=math.nextafter(2.0, 3.0)),), {}),
        lambda: ((Scaled(np.ones(3, np.float32)),), {"power": 2}),
        lambda: ((Scaled(np.ones(3, np.float32)),), {"other": np.ones(2, np.float32)}),
        lambda: ((Scaled(np.ones(3, np.float32)), np.ones(2, np.float32)), {}),
        # A number of Python's gives way to the type of an array.
        lambda: ((Scaled(jnp.ones(3)), jnp.asarray(1.0)), {}),
        lambda: ((Scaled(jnp.ones(3)), jnp.float32(1.0)), {}),
    ],
)
def test_another_call_is_traced(folder: Path, other: Any) -> None:
    called(yields, Scaled(np.ones(3, np.float32)))
    arguments, named = other()
    found = called(yields, *arguments, **named)
    assert len(traces) == len(list(folder.iterdir())) == 2
    jax.tree.map(np.testing.assert_array_equal, yields(*arguments, **named), found)


def test_the_precision_and_the_settings_of_jax_are_part_of_the_name(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called(yields, Scaled(np.ones(3, np.float32)))
    with jax.enable_x64(True):
        assert called(yields, Scaled(np.ones(3)))[0].mass.dtype == np.float64
        called(yields, Scaled(np.ones(3, np.float32)))
    monkeypatch.setenv("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    called(yields, Scaled(np.ones(3, np.float32)))
    monkeypatch.setattr(kept, "_source", lambda: "written on")
    called(yields, Scaled(np.ones(3, np.float32)))
    assert len(traces) == len(list(folder.iterdir())) == 5


def test_what_has_no_name_is_traced_and_not_kept(folder: Path) -> None:
    def inner(one: Scaled) -> Array:
        traces.append("inner")
        return jnp.asarray(one.value + 1.0)

    for _ in range(2):
        assert called(inner, Scaled(jnp.ones(2))).tolist() == [2.0, 2.0]
        found = called(yields, Scaled(jnp.ones(2), factor=_Odd(2.0)))
        assert found[0].mass.tolist() == [2.0, 2.0]
    assert sorted(traces) == ["inner", "yields"]
    assert list(folder.iterdir()) == []


class _Odd(float):
    """It has a name, and is no float."""


def test_names_are_those_of_one_thing() -> None:
    assert name_of(Performance) == "wlplan.types:Performance"
    assert plain(jax.nn.swish) != plain(jax.nn.relu)
    parts = [functools.partial(jax.nn.gelu, approximate=one) for one in (True, False)]
    assert len({name_of(part) for part in (*parts, jax.nn.gelu)}) == 3
    for foreign in (
        lambda: 0,
        functools.partial(yields),
        yields,
        Path,
        _Odd(1.0),
        object(),
        {"a": lambda: 0},
        [Path()],
    ):
        with pytest.raises(NamelessError):
            plain(foreign)
    different = [0, False, 0.0, -0.0, "0", None, (), [], {}, np.float32(0), np.float64(0)]
    different += [np.zeros(1), np.zeros((1, 1)), np.dtype("f4"), (0,), ((0,),), {"0": 0}, {0: 0}]
    assert len({repr(plain(one)) for one in different}) == len(different)


@pytest.mark.parametrize(
    "mend", [lambda b: b[:-9], lambda b: b[:40], lambda b: b"", lambda b: b"{}\n"]
)
def test_a_broken_file_is_made_anew(folder: Path, mend: Any) -> None:
    one = Scaled(np.ones(3, np.float32))
    called(yields, one)
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(mend(whole))
    assert read(path) is None
    assert called(yields, one)[0].mass.tolist() == [2.0, 2.0, 2.0]
    assert len(traces) == 2
    assert read(path) is not None


def test_where_nothing_can_be_written_it_is_traced(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(folder / "not there" / "at all"))
    assert called(yields, Scaled(jnp.ones(2)))[0].mass.tolist() == [2.0, 2.0]
    assert traces == ["yields"]


def test_within_a_trace_it_is_a_part_of_it(folder: Path) -> None:
    function = Traced(yields, ("power",))

    def total(value: Array) -> Array:
        return jnp.sum(function(Scaled(value), power=2)[0].mass)

    gradient = jax.grad(total)(jnp.arange(3.0))
    assert gradient.tolist() == [0.0, 4.0, 8.0]
    assert jax.vmap(total)(jnp.ones((2, 3))).tolist() == [6.0, 6.0]
    assert list(folder.iterdir()) == []


@pytest.mark.skipif(
    hasattr(nnx.Linear(1, 1, rngs=nnx.Rngs(0)), "kernel_init"),
    reason="this Flax keeps a function in each layer that has no name: models are traced as ever",
)
def test_all_that_ships_has_a_name_and_a_different_one() -> None:
    pile = wlplan.seed_pile("conical", slope=0.5, height=2.0, seed=1)
    site = wlplan.Site()
    sites = [site, site.replace(machine=dataclasses.replace(WA320, bucket_width=2.6))]
    sites.append(site.replace(soil=dataclasses.replace(GRAVEL, friction=GRAVEL.friction + 1e-9)))
    jobs = [make_job(wlplan.load_world("hybrid"), pile, site=one) for one in sites]
    jobs += [make_job(wlplan.load_world(name), pile) for name in ("low", "high", "simulator")]
    jobs += [jobs[0].replace(amount=of) for of in (Tonnes(9.0), Trucks(2, 24.0), Empty())]
    jobs += [
        make_job(wlplan.load_world("hybrid"), pile, objective=of, amount=Loads(3))
        for of in ("delivery", {"mass": 2.0, "time": 1.0}, {"mass": 2.0, "time": 1.0 + 1e-9})
    ]
    names = {repr(kept._tree(jax.tree.structure(job))) for job in jobs}
    assert len(names) == len(jobs)
    mine = make_job(wlplan.load_world("hybrid"), pile, objective=lambda loading: loading.pose.x)
    with pytest.raises(NamelessError):
        kept._tree(jax.tree.structure(mine))


SCRIPT = f"""
from wlplan.cli import programs
folder = programs.use_cache().folder
import jax, wlplan
from wlplan import traced
made, lowered = [], traced._Call.lowered
traced._Call.lowered = lambda call, leaves: made.append(call) or lowered(call, leaves)
from wlplan.planning.load_search import quick_ways
from wlplan.planning.job import make_job, with_toe
pile = wlplan.seed_pile("conical", slope=0.5, height=2.0, seed=1)
job = with_toe(make_job(wlplan.load_world("hybrid"), pile))
quick_ways(job, pile, jax.numpy.linspace(0.1, 0.9, 4))
print(len(made), len(list(folder.glob("*{ENDING}"))), len(programs.cache().programs()))
"""


def test_the_command_line_keeps_them(tmp_path: Path) -> None:
    environment = {**os.environ, programs.VARIABLE: str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    environment.pop(VARIABLE, None)
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        said.append(done.stdout.split())
    assert [words[0] for words in said] == ["2", "0"]
    assert said[0][1] == said[1][1] == "2"
    assert int(said[1][2]) > 2


def test_without_what_jax_writes_by_it_is_traced(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, program: Any) -> None:
        raise ImportError("Please install 'flatbuffers'")

    monkeypatch.setattr(kept, "write", write)
    assert called(yields, Scaled(jnp.ones(2)))[0].mass.tolist() == [2.0, 2.0]
    assert traces == ["yields"]
    assert list(folder.iterdir()) == []


def wrong(one: Scaled) -> Array:
    """What goes wrong as it is traced."""
    traces.append("wrong")
    raise InputError("it makes no sense.")


def test_what_goes_wrong_in_a_trace_is_said_once(folder: Path) -> None:
    with pytest.raises(InputError, match="no sense"):
        called(wrong, Scaled(jnp.ones(2)))
    assert traces == ["wrong"]
    assert list(folder.iterdir()) == []


def test_two_threads_may_come_with_the_same_class(monkeypatch: pytest.MonkeyPatch) -> None:
    """JAX refuses a class that it knows already."""

    class Pair(NamedTuple):
        one: int

    known = list[type]()

    def slow(kind: type, **_: object) -> None:
        was = kind in known
        time.sleep(0.05)
        if was or kind in known:
            raise ValueError("Duplicate")
        known.append(kind)

    monkeypatch.setattr(jax.export, "register_namedtuple_serialization", slow)
    monkeypatch.setattr(kept, "name_of", lambda kind: kind.__name__)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(kept._register, [Pair] * 4))
    assert known == [Pair]


@pytest.mark.slow
def test_a_plan_that_is_played_by_it_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All programs that planning keeps, with the types that they are declared with."""
    pile, world = cones.cone(), wlplan.world(cones.bowl_world)
    monkeypatch.setattr(kept, "_KNOWN", (*kept._KNOWN, "cones"))
    plain_one = wlplan.plan_loads(world, pile, loads=2, site=cones.SITE, planner="greedy")
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    for _ in range(2):
        plan = wlplan.plan_loads(world, pile, loads=2, site=cones.SITE, planner="greedy")
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), plain_one, plan
        )
    names = {path.suffix for path in tmp_path.iterdir()}
    assert names == {ENDING}
