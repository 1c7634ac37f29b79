"""What the paper reports of its models, on the data of its own simulator: its tables 1 to 3."""

from __future__ import annotations

from typing import NamedTuple


class PerformanceResult(NamedTuple):
    """A column of table 1: a performance predictor on 1,072 held-out cycles."""

    mass: float  # mean relative errors [1]
    time: float
    work: float
    inference: float  # time of one inference [s]


class PileStateResult(NamedTuple):
    """A row of table 2: the pile state predictor on held-out cycles."""

    mean_absolute: float  # misplaced volume [m³]
    mean_relative: float  # over the volume under the simulated surface [1], equation 15
    inference: float  # time of one inference [s]


class SequenceResult(NamedTuple):
    """Sums over 40 loadings in sequence, the last row of table 3."""

    mass: float  # [tonne]
    time: float  # [s]
    work: float  # [MJ]
    volume: float  # of the pile that is left [m³]


PERFORMANCE = {
    ("psi_high", "leaky_relu"): PerformanceResult(0.0447, 0.0361, 0.0590, 1.13e-3),
    ("psi_high", "swish"): PerformanceResult(0.0570, 0.0443, 0.0698, 1.27e-3),
    ("psi_low", "leaky_relu"): PerformanceResult(0.0777, 0.0566, 0.0851, 0.31e-3),
    ("psi_low", "swish"): PerformanceResult(0.0758, 0.0541, 0.0847, 0.36e-3),
}
"""Table 1, by model and activation."""

PILE_STATE = {
    True: PileStateResult(0.75, 0.0304, 4.51e-3),
    False: PileStateResult(0.84, 0.0341, 4.48e-3),
}
"""Table 2, with and without post-processing."""

SEQUENCE = {
    "simulator": SequenceResult(116.0, 443.0, 17.9, 709.5),
    "high": SequenceResult(118.6, 441.9, 17.4, 664.2),
    "low": SequenceResult(130.9, 418.8, 16.6, 700.6),
}
"""Table 3, by world."""
