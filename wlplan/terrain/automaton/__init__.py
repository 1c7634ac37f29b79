"""The avalanche automaton: soil slides downhill until no slope exceeds the angle of repose.

One sweep moves, along every edge between neighbouring cells i and k at distance d, the height
f * max(h_i - h_k - d tan(repose), 0) from the higher to the lower cell (eight neighbours). The
flow is antisymmetric, so volume is kept by construction; with f = 1/8 the Jacobian of a sweep is
symmetric, not negative and has unit row sums, so a sweep is monotone, non-expansive in every
p-norm, and its gradient cannot explode. This is our reading of the mass-preserving automaton of
Pla-Castells et al. (2004), which the paper employs (section 4.6), with eight neighbours
instead of four. `sweeps` and `converged` are this automaton as it stands.

Sweeps alone take thousands to bring a bucket's hole to rest. `settle` gets there in dozens:

- Coarse to fine. Heights are averaged onto grids of twice and four times the spacing, relaxed
  there first, and the change is interpolated back with its volume kept. A surface that is relaxed
  is relaxed on every level, so `settle` does not move it.
- Momentum. A sweep is a step of gradient descent on the energy sum max(excess, 0)^2 / 2, and the
  heavy-ball method speeds that up. It starts anew as soon as its velocity points uphill, which
  keeps it from overshooting.
- Neither takes more from a cell than lies on its floor, or gives soil to cells that do not exchange
  any with it: it does not pass a wall.
- Rounds of both are repeated until the steepest slope is within a tolerance, and no more.

Gradients: reverse mode with respect to the height, exact for the sweeps that were made, by rules
of our own. Forward mode is not available (JAX says so), and the floor and the angle of repose
count as constants.
"""

from wlplan.terrain.automaton.flow import FLOW_FRACTION, converged, sweep, sweeps
from wlplan.terrain.automaton.relaxation import relax, settle, settle_dug
from wlplan.terrain.automaton.rounds import DEFAULT_SCHEDULE, Schedule
from wlplan.terrain.automaton.slopes import movable, steepest_slope
from wlplan.terrain.automaton.windows import paste, window_of

__all__ = [
    "DEFAULT_SCHEDULE",
    "FLOW_FRACTION",
    "Schedule",
    "converged",
    "movable",
    "paste",
    "relax",
    "settle",
    "settle_dug",
    "steepest_slope",
    "sweep",
    "sweeps",
    "window_of",
]
