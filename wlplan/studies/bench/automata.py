"""The automaton, and those that others would write."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np

from wlplan.constants import CELL_SIZE
from wlplan.site.soil import GRAVEL
from wlplan.studies.bench.baselines import Rested, aeolis_rest, numba_sweeps, numpy_sweeps, rest
from wlplan.studies.bench.digs import Dig
from wlplan.studies.bench.setup import Item, Measured, Setup, after_a_load, floats, loaded, stacked
from wlplan.studies.bench.timing import compiled, timed
from wlplan.terrain.automaton import converged, steepest_slope
from wlplan.types import Pile

# The tolerance that every automaton is run to, and the one the result is judged by, which leaves
# room for the rounding of float32 [rad].
_TOLERANCE = math.radians(1.0)
_STEEPEST = math.degrees(GRAVEL.repose_angle + _TOLERANCE) + 1e-3
_PILES = 64  # of a batch of piles


def _pasted(dig: Dig) -> np.ndarray:
    height = np.asarray(dig.pile.height, np.float64)
    i, j = (int(first) for first in dig.start)
    n, m = dig.dug.height.shape
    height[i : i + n, j : j + m] = dig.dug.height
    return height


def _quality(before: Sequence[Any], after: Sequence[Any], digs: Sequence[Dig]) -> dict[str, float]:
    """The worst over all digs, of the surfaces before and after they slid [m].

    The volume that comes or goes counts against that of the window.
    """
    slope = jax.jit(steepest_slope)
    slopes = [
        float(slope(dig.dug.replace(height=floats(h)))) for h, dig in zip(after, digs, strict=True)
    ]
    changes = [
        abs(float(np.asarray(h, np.float64).sum() - np.asarray(b, np.float64).sum()))
        / float(np.asarray(dig.dug.height, np.float64).sum())
        for b, h, dig in zip(before, after, digs, strict=True)
    ]
    return {
        "steepest_slope_degrees": math.degrees(max(slopes)),
        "relative_volume_change": max(changes),
    }


def _measure_avalanche(setup: Setup) -> Measured:
    run, seconds = setup.settle_dug
    (found,) = setup.timed([run], [loaded(dig) for dig in setup.digs])
    before = [_pasted(dig) for dig in setup.digs]
    return Measured(seconds, found.timing, _quality(before, found.results, setup.digs))


def _measure_avalanche_gradient(setup: Setup) -> Measured:
    cases = [loaded(dig) for dig in setup.digs]
    weight = floats(np.random.default_rng(setup.seed).normal(size=setup.digs[0].pile.height.shape))
    forward, _ = setup.settle_dug
    gradient, seconds = compiled(
        jax.grad(lambda pile, dug, start: (weight * after_a_load(pile, dug, start)).sum(), 1),
        *cases[0],
    )
    one, both = setup.timed([forward, gradient], cases)
    ratio = both.timing.median / one.timing.median
    return Measured(seconds, both.timing, {"ratio_to_forward": ratio})


def _measure_avalanche_batch(setup: Setup) -> Measured:
    cases = [loaded(setup.digs[k % len(setup.digs)]) for k in range(_PILES)]
    one, _ = setup.settle_dug
    batch = stacked(cases)
    many, seconds = compiled(jax.vmap(after_a_load), *batch)
    together, apart = setup.timed(
        [lambda: many(*batch), lambda: [jax.block_until_ready(one(*case)) for case in cases]],
        [()],
    )
    figures = {
        # Of the same piles, since some take longer than others.
        "ratio_to_one": _PILES * together.timing.median / apart.timing.median,
        "seconds_each": together.timing.median / _PILES,
    }
    return Measured(seconds, together.timing, figures)


def _measure_settle(setup: Setup) -> Measured:
    digs = setup.baseline_digs
    settled, seconds = setup.settle
    (found,) = setup.timed([settled], [(dig.dug,) for dig in digs])
    heights = [pile.height for pile in found.results]
    return Measured(
        seconds, found.timing, _quality([dig.dug.height for dig in digs], heights, digs)
    )


def _beside_settle(
    setup: Setup, automaton: Callable[[Pile, np.ndarray], Rested], seconds: float | None
) -> Measured:
    """An automaton on windows, in turn with `settle`.

    Args:
        setup: Holds the digs.
        automaton: Takes a window as a pile and as a NumPy array.
        seconds: What its compiling took [s].
    """
    digs = setup.baseline_digs
    heights = [np.array(dig.dug.height) for dig in digs]
    settled, _ = setup.settle
    found, ours = timed(
        [automaton, lambda window, _: settled(window)],
        [(dig.dug, height) for dig, height in zip(digs, heights, strict=True)],
        seconds=0.0 if setup.quick else 2.0,
    )
    rested: list[Rested] = found.results
    sweeps = [result.sweeps for result in rested if result.sweeps is not None]
    return Measured(
        seconds,
        found.timing,
        {
            "times_settle": found.timing.median / ours.timing.median,
            **_quality(heights, [result.height for result in rested], digs),
            **({"sweeps": float(np.median(sweeps))} if sweeps else {}),
        },
    )


def _measure_xla(setup: Setup) -> Measured:
    run, seconds = compiled(
        functools.partial(converged, tolerance=_TOLERANCE), setup.baseline_digs[0].dug
    )

    def automaton(window: Pile, _: np.ndarray) -> Rested:
        return Rested(run(window).height, None)

    return _beside_settle(setup, automaton, seconds)


_REST = {"cell_size": CELL_SIZE, "repose_angle": GRAVEL.repose_angle, "tolerance": _TOLERANCE}


def _measure_numpy(setup: Setup) -> Measured:
    return _beside_settle(setup, lambda _, height: rest(numpy_sweeps, height, **_REST), None)


def _measure_numba(setup: Setup) -> Measured:
    if find_spec("numba") is None:
        return Measured(note="Numba is not installed: pip install wlplan[bench]")
    start = time.perf_counter()
    numba_sweeps(np.zeros((2, 2), np.float32), 1.0, 1)
    seconds = time.perf_counter() - start
    return _beside_settle(setup, lambda _, height: rest(numba_sweeps, height, **_REST), seconds)


def _measure_aeolis(setup: Setup) -> Measured:
    if find_spec("aeolis") is None:
        return Measured(note="AeoLiS is not installed: pip install aeolis")
    return _beside_settle(setup, lambda _, height: aeolis_rest(height, **_REST), None)


AVALANCHES = (
    Item(
        "avalanche",
        "one relaxation after a loading",
        _measure_avalanche,
        "low world",
        "paper 1.1 s; plain XLA to 0.5° of repose 45 ms",
        "≤ 2 ms, ≤ 33°, volume to 1e-6",
        most={"run": 2e-3, "steepest_slope_degrees": _STEEPEST, "relative_volume_change": 1e-6},
    ),
    Item(
        "avalanche-gradient",
        "gradient of it with respect to the heights",
        _measure_avalanche_gradient,
        "low world",
        "naive reverse mode 6 × forward",
        "≤ 4 × forward",
        most={"ratio_to_forward": 4.0},
    ),
    Item(
        "avalanche-batch",
        f"{_PILES} piles in one call",
        _measure_avalanche_batch,
        "low world",
        target=f"≤ {_PILES} × one",
        most={"ratio_to_one": float(_PILES)},
    ),
)
"""Relaxation after a loading."""

BASELINES = (
    Item("settle", "windows of the same digs by `settle`", _measure_settle, "automata"),
    Item("xla", "plain sweeps, XLA", _measure_xla, "automata"),
    Item("numba", "plain sweeps, Numba", _measure_numba, "automata"),
    Item("numpy", "plain sweeps, NumPy", _measure_numpy, "automata"),
    Item("aeolis", "the avalanches of AeoLiS", _measure_aeolis, "automata"),
)
"""Relaxation of windows, beside other automata."""
