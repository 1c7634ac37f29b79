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
    """A column block of table 3: sums over loadings in sequence, after 5, 10, ... 40 of them."""

    mass: tuple[float, ...]  # [tonne]
    time: tuple[float, ...]  # [s]
    work: tuple[float, ...]  # [MJ]
    volume: tuple[float, ...]  # of the pile that is left [m³]


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

SEQUENCE_LOADS = (5, 10, 15, 20, 25, 30, 35, 40)
"""Loadings after which table 3 has the sums."""

SEQUENCE = {
    "simulator": SequenceResult(
        (14.7, 28.2, 40.8, 56.8, 71.0, 86.1, 101.4, 116.0),
        (55.8, 106.1, 161.1, 218.0, 273.7, 327.3, 389.4, 443.0),
        (2.0, 4.1, 6.5, 8.9, 11.1, 13.2, 15.7, 17.9),
        (768.6, 760.7, 753.3, 744.0, 735.7, 726.9, 718.0, 709.5),
    ),
    "high": SequenceResult(
        (15.7, 31.5, 45.3, 62.0, 75.4, 90.5, 106.3, 118.6),
        (53.2, 101.0, 155.4, 210.8, 265.7, 318.7, 385.1, 441.9),
        (2.0, 3.9, 6.1, 8.5, 10.6, 12.8, 15.3, 17.4),
        (765.9, 755.9, 745.6, 728.7, 714.7, 700.1, 679.1, 664.2),
    ),
    "low": SequenceResult(
        (16.1, 31.3, 47.0, 64.4, 80.6, 96.6, 114.3, 130.9),
        (54.5, 101.9, 154.5, 208.1, 260.2, 308.9, 369.9, 418.8),
        (2.0, 3.8, 6.0, 8.3, 10.4, 12.4, 14.6, 16.6),
        (767.7, 758.8, 749.7, 739.5, 730.1, 720.7, 710.4, 700.6),
    ),
}
"""Table 3, by world: one pile and one sequence of loadings."""
