"""The weights that ship with the package: one call makes all of them from nothing."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from wlplan.dataset import collect, fingerprint, open_dataset
from wlplan.dataset.store import is_new, read_attributes
from wlplan.errors import InputError
from wlplan.io.provenance import versions
from wlplan.models.storage import load_model, read_description
from wlplan.training.settings import (
    PhiSettings,
    PsiHighSettings,
    PsiLowSettings,
    Settings,
    StallSettings,
)
from wlplan.training.trainer import train


class _Part(NamedTuple):
    """A data set of those that the models are trained on."""

    suffix: str  # of its name
    protocol: str
    cycles: int


# The first is as large as the paper's; figures that stand beside the paper's are of it and of
# models trained on it alone. With all of them ψ_high errs by half as much. Each has a seed of its
# own: with the same, piles and first loadings would be the same too.
_DATA = (
    _Part("", "paper", 10_800),
    _Part("-corridor", "corridor", 10_800),
    _Part("-more", "paper", 54_000),
    _Part("-corridor-more", "corridor", 54_000),
    _Part("-slow", "slow", 32_400),
    _Part("-past-toe", "past-toe", 54_000),
)

# With so many cycles no unit has to be dropped, and ψ_high is as good with three layers of 256
# units as of 512.
SHIPPED: tuple[Settings, ...] = (
    PsiLowSettings(members=5, hidden=(128,) * 3, dropout=0.0, epochs=40, batch=256),
    PsiHighSettings(members=5, hidden=(256,) * 3, dropout=0.0, epochs=60, batch=256),
    PhiSettings(hidden=(448,) * 3, dropout=0.0, epochs=40, batch=256),
    StallSettings(hidden=(128,) * 3, dropout=0.0, epochs=24, batch=256),
)
"""How the models that ship are trained, apart from the seed."""


def train_all(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    epochs: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Trains every model that ships and saves them side by side.

    If killed, the same call continues where it was: models that it has finished are kept.

    Args:
        data: Data set of the paper's protocol; the others lie beside it, with something added to
            the name. Each is collected if there is none or a part of it.
        out: Directory of the models, each in one of its own: `psi_low`, `psi_high`, `phi`, `stall`.
        seed: Seed of collection and training.
        epochs: Passes over the data for every model; None: of each its own.
        progress: Called with what is done, how far it is, and how far it goes; of a training with
            the kind of the model, of one that is kept not at all.

    Returns:
        The errors of each model on the test part, as JSON has them.

    Raises:
        InputError: As for `collect` and the trainings.
    """

    def progress_of(name: str) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, total: progress(name, done, total)

    data = Path(data)
    datasets = []
    for number, part in enumerate(_DATA):
        place = data.with_name(f"{data.stem}{part.suffix}{data.suffix}")
        advance = progress_of(f"cycles, {place.name}")
        if is_new(place):
            collect(
                place,
                cycles=part.cycles,
                seed=seed + number,
                protocol=part.protocol,
                progress=advance,
            )
        elif (begun := read_attributes(place)).get("cycles_done") != begun.get("cycles"):
            same = {name: begun[name] for name in ("cycles", "seed", "protocol")}
            collect(place, **same, progress=advance)
        datasets.append(open_dataset(place))
    marks = [fingerprint(dataset) for dataset in datasets]
    reports = {}
    for settings in SHIPPED:
        wanted = dataclasses.replace(
            settings, seed=seed, epochs=settings.epochs if epochs is None else epochs
        )
        place = Path(out) / wanted.kind
        if not _is_done(place, marks, wanted):
            train(wanted, datasets, out=place, progress=progress_of(wanted.kind))
        reports[wanted.kind] = read_description(place, wanted.kind)["held_out"]
    return reports


def _is_done(place: Path, marks: list[str], settings: Settings) -> bool:
    """Whether a training with these settings has ended before."""
    try:
        load_model(place, settings.kind)
        description = read_description(place, settings.kind)
    except InputError:
        return False
    return bool(
        description["training"].get("settings") == settings.as_dict()
        and description["dataset"].get("fingerprints") == marks
        and description["versions"] == versions()
    )
