"""Makes the stored references of the tests.

    python tests/regenerate.py calibration.npz

`calibration.npz` holds loading cycles of an independent discrete-element engine (LAMMPS), played in
closed loop with the same controller; its fields are named in the code. Kept of them: the surface,
the action and the outcome.
"""

import sys
from pathlib import Path

import numpy as np

PROVENANCE = (
    "Discrete-element loading cycles (LAMMPS, 5,700 to 10,700 spheres, closed loop with the "
    "admittance controller), the 39 of calibration.npz, by tests/regenerate.py. "
    "h0_cg: solid volume a column over the packing fraction, smoothed over 0.13 m [m], cells at "
    "x = -0.95..4.15, y = -2.55..2.55 of the dig pose. Soil 1727 kg/m^3, repose 33 +- 3 degrees. "
    "One packing against another: mass sd 2-6 %. A guard against regressions, not a validation."
)


def dem_cycles(calibration):
    """Surface [m], action, mass [tonne], time [s] and work without slip [kJ] of every cycle."""
    return {
        "h0_cg": calibration["h0_cg"].astype(np.float16),
        "action": calibration["action"].astype(np.float32),
        "mass_t": calibration["mass_t"].astype(np.float32),
        "time_s": calibration["time_s"].astype(np.float32),
        "work_kJ": calibration["work_kJ"].astype(np.float32),
        "provenance": np.array(PROVENANCE),
    }


def main(path):
    """Writes tests/references/dem_cycles.npz."""
    target = Path(__file__).parent / "references" / "dem_cycles.npz"
    target.parent.mkdir(exist_ok=True)
    with np.load(path) as calibration:
        np.savez_compressed(target, **dem_cycles(calibration))
    print(f"{target}: {target.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
