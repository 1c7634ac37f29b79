"""Makes the stored references of the tests and of `experiments.dem_reference`.

    python tests/regenerate.py calibration.npz      the 39 cycles that constants were fitted to
    python tests/regenerate.py FOLDER_OF_CYCLES     others, that nothing was fitted to
    python tests/regenerate.py RIDGES.npz           those of `experiments.dem_cycles --lane ridge`

All hold loading cycles of an independent discrete-element engine (LAMMPS), played in closed loop
with the same controller; their fields are named in the code. `python -m experiments.dem_cycles`
makes more of the kind. Kept of a cycle: surface before and after, action, outcome, and the path of
the bucket with the forces on it until filling ends.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

PROVENANCE = (
    "Discrete-element loading cycles (LAMMPS, 5,400 to 11,000 spheres, closed loop with the "
    "admittance controller), by tests/regenerate.py. h0_cg, h1_cg: solid volume a column over the "
    "packing fraction before and after, smoothed over 0.13 m [mm], cells at x = -0.95..4.15, "
    "y = -2.55..2.55 of the dig pose. Soil 1727 kg/m^3, repose 33 +- 3 degrees. path: see "
    "path_names, until filling ends, NaN after. One packing against another: mass sd 2-6 %. "
)
FITTED = "The 39 cycles of 22 piles that constants of the simulator were fitted to."
HELD_OUT = (
    "Nothing was fitted to these. Seed 51: six surfaces and actions, each in three packings, of "
    "which the first were looked at when the form of the force law was chosen. Seed 52: two "
    "loadings a pile."
)
# Columns of a record that are kept, by their place in it.
PATH = {"t": 0, "tip_x": 10, "tip_z": 11, "tilt": 3, "speed": 4, "force_x": 5, "force_z": 6}
_PHASE, _FILLING = 15, 1
_ROWS = 420


def path_of(record: np.ndarray) -> np.ndarray:
    """The kept columns while the bucket fills, [rows, 7] in SI units, NaN after."""
    record = record[~np.isnan(record[:, 0])]
    filling = record[record[:, _PHASE] <= _FILLING][:, list(PATH.values())]
    path = np.full((_ROWS, len(PATH)), np.nan, np.float32)
    path[: len(filling)] = filling[:_ROWS]
    return path


def small(heights: npt.ArrayLike) -> np.ndarray:
    """Heights in whole millimetres."""
    return np.round(1000.0 * np.asarray(heights)).astype(np.int16)


def fitted(path: Path) -> dict[str, np.ndarray]:
    """Fields of the cycles of calibration.npz."""
    with np.load(path) as calibration:
        return {
            "h0_cg": small(calibration["h0_cg"]),
            "h1_cg": small(calibration["h1_cg"]),
            "path": np.stack([path_of(record) for record in calibration["traj"]]),
            "pile_id": calibration["pile_id"].astype(str),
            "packing": np.zeros(len(calibration["mass_t"]), np.int32),
            "stop_reason": calibration["stop_reason"].astype(str),
            **{
                name: calibration[name].astype(np.float32)
                for name in ("action", "mass_t", "time_s", "work_kJ", "work_parts_kJ")
            },
            "provenance": np.array(PROVENANCE + FITTED),
        }


def held_out(folder: Path) -> dict[str, np.ndarray]:
    """Fields of cycles that lie in files of their own."""
    cycles = [np.load(path) for path in sorted(folder.glob("*.npz"))]

    def joined(name: str, dtype: npt.DTypeLike = np.float32) -> np.ndarray:
        return np.stack([cycle[name] for cycle in cycles]).astype(dtype)

    return {
        "h0_cg": small([cycle["h0cg"] for cycle in cycles]),
        "h1_cg": small([cycle["h1cg"] for cycle in cycles]),
        "path": np.stack([path_of(cycle["traj"]) for cycle in cycles]),
        "pile_id": np.array([f"{cycle['seed']}-{cycle['pile']}" for cycle in cycles]),
        "packing": np.array([cycle.get("packing", 0) for cycle in cycles], np.int32),
        "stop_reason": joined("stop", str),
        "action": joined("a"),
        "mass_t": joined("mass"),
        "time_s": joined("time"),
        "work_kJ": joined("work"),
        "work_parts_kJ": joined("work_parts"),
        "provenance": np.array(PROVENANCE + HELD_OUT),
    }


def lane(path: Path) -> None:
    """Writes the cycles over ridges without what no comparison needs: paths and envelopes."""
    with np.load(path) as cycles:
        kept: dict[str, Any] = {
            name: cycles[name] for name in cycles if name not in ("traj", "traj_names", "h0", "h1")
        }
    target = Path(__file__).parent / "references" / "dem_lane.npz"
    np.savez_compressed(target, **kept)
    print(f"{target}: {len(kept['mass_t'])} cycles, {target.stat().st_size / 1024:.0f} KiB")


def main(path: Path) -> None:
    """Writes the reference that a path is the source of."""
    if not path.is_dir():
        with np.load(path) as archive:
            if "ridge_m" in archive:
                return lane(path)
    name, fields = (
        ("dem_held_out", held_out(path)) if path.is_dir() else ("dem_cycles", fitted(path))
    )
    longest = int((~np.isnan(fields["path"][:, :, 0])).sum(axis=1).max())
    fields["path"] = fields["path"][:, :longest]
    target = Path(__file__).parent / "references" / f"{name}.npz"
    target.parent.mkdir(exist_ok=True)
    named: dict[str, Any] = {"path_names": np.array(list(PATH)), **fields}
    np.savez_compressed(target, **named)
    print(f"{target}: {len(fields['mass_t'])} cycles, {target.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
