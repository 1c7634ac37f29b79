"""What every training does: split the data, fit and resume, evaluate, save.

`train` is the one entry to all of them.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from flax import nnx

from wlplan.dataset import Dataset, fingerprint, join, probes_of, split
from wlplan.errors import InputError
from wlplan.io.provenance import versions
from wlplan.models.storage import Model, check_target, save_model
from wlplan.training.fitting import OPTIMISER_NAMES, Loss, SavedState, fit_network
from wlplan.training.settings import Settings
from wlplan.types import PyTree

# Training, validation and test, by what the split is by. Paper, section 6.4.1: 10,718 cycles, 1,072
# of them for the test, 10 % of the rest for validation.
_FRACTIONS = {"rollout": (0.8, 0.1, 0.1), "cycle": (0.81, 0.09, 0.1)}


@runtime_checkable
class Report(Protocol):
    """Errors of a model, as JSON has them."""

    def as_dict(self) -> dict[str, Any]:
        """The errors by name."""


AnyModel = TypeVar("AnyModel", bound=Model)
AnyReport = TypeVar("AnyReport", bound=Report)


Progress = Callable[[int, int], None]
"""Called with the number of epochs done and in all."""


def train(
    settings: Settings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> tuple[Any, Report]:
    """Trains a model on a data set and saves it.

    The data set is split by rollout, or as the settings say, alike for all seeds, so that errors
    can be compared. Of all epochs the weights with the least loss on the validation part are kept;
    the report is on the test part, which plays no role in training. If killed, the same call
    continues where it was and ends with the same weights.

    Args:
        settings: What is trained, and how: `PsiLowSettings`, `PsiHighSettings`, `PhiSettings` or
            `PhiVaeSettings`.
        dataset: Loading cycles, of one or several data sets, each split by itself; those that are
            not valid are left out.
        out: Directory to save to; an older model there is replaced. None: nothing is saved.
        progress: Called with the number of epochs done and in all.

    Returns:
        The model, of the kind of the settings, and its errors on the test part.

    Raises:
        InputError: If the data set is too small or not finite, if training diverges, or if the
            model cannot be saved.
    """
    training: Any = importlib.import_module(f"{__package__}.{settings.kind}")
    trained: tuple[Any, Report] = training.train(settings, dataset, out=out, progress=progress)
    return trained


class Trainer:
    """A training from its data set to the saved model.

    The data set is split without the cycles that are not valid. A training that was killed
    continues where it was when asked for again, and ends with the same weights.

    Args:
        dataset: Loading cycles, of one or several data sets; each is split by itself.
        out: Directory to save to; an older model there is replaced. None: nothing is saved.
        settings: How it is trained.
        tables: Arrays of a part of the data that the training looks at.
        by: What the parts do not share, one of `SPLITS`.
        samples: Cycles of each data set for training and validation, drawn at random; 0: all.

    Attributes:
        cycles: Number of cycles of the training, the validation and the test part.
        tables: Arrays of the training and of the validation part, by name.
        validation: Cycles of the validation part.
        test: Cycles of the test part.

    Raises:
        InputError: If the data set is too small or not finite, or the directory cannot be one of
            a model.
    """

    def __init__(
        self,
        dataset: Dataset | Sequence[Dataset],
        out: str | os.PathLike[str] | None,
        settings: Settings,
        tables: Callable[[Dataset], Mapping[str, np.ndarray]],
        *,
        by: str = "rollout",
        samples: int = 0,
    ):
        self._out = None if out is None else Path(out)
        if self._out is not None:
            check_target(self._out)
        datasets = [dataset] if isinstance(dataset, Dataset) else list(dataset)
        self._fractions = _FRACTIONS[by]
        # Of the training parts only the tables are kept, which are a fraction of it.
        rows: list[list[Mapping[str, np.ndarray]]] = []
        self.cycles = [0, 0, 0]
        used = []
        for each in datasets:
            every = split(each, fractions=self._fractions, by=by)
            parts = [part.select(part.valid) for part in every]
            if samples:
                parts[:2] = self._drawn(parts[:2], samples, settings.seed)
            arrays = [tables(part) for part in parts]
            if not all(np.isfinite(v).all() for table in arrays for v in table.values()):
                raise InputError(
                    "The data set holds numbers that are not finite: collect it again."
                )
            rows.append(arrays[:2])
            self.cycles = [n + len(part) for n, part in zip(self.cycles, parts, strict=True)]
            used.append(parts[1:])
        self.validation, self.test = (join(parts) for parts in zip(*used, strict=True))
        if not all(self.cycles):
            raise InputError("The data set has too few valid cycles to split: collect more cycles.")
        self.tables = [
            {name: np.concatenate([table[name] for table in part]) for name in part[0]}
            for part in zip(*rows, strict=True)
        ]
        self._settings = settings
        self._data = {
            "fingerprints": [fingerprint(each) for each in datasets],
            # Of the first; the others are of the same soil and machine.
            **datasets[0].attributes,
            "protocols": [each.attributes.get("protocol") for each in datasets],
            "seeds": [each.attributes.get("seed") for each in datasets],
            "probes": probes_of(datasets[0]),
        }
        self._records: dict[str, dict[str, Any]] = {}
        self._states: list[SavedState] = []

    def fit(
        self,
        networks: Sequence[nnx.Module],
        loss: Loss,
        examples: list[PyTree],
        *,
        stage: str = "",
        augment: Callable[..., PyTree] | None = None,
        progress: Progress | None = None,
    ) -> Any:
        """Fits a network, or the members of an ensemble, to examples.

        Args:
            networks: Network to start from, or those of all members of an ensemble.
            loss: Loss to reduce.
            examples: Examples of the training and of the validation part.
            stage: Name of a part of the training, where it has several.
            augment: Changes the examples of a step at random.
            progress: Called with the number of epochs done and in all.

        Returns:
            The state with the least validation loss; of several networks stacked.

        Raises:
            InputError: If the training diverges.
        """
        state = self._state_of(stage)
        best, self._records[stage] = fit_network(
            networks,
            loss,
            examples[0],
            examples[1],
            self._settings,
            augment=augment,
            state=state,
            progress=progress,
        )
        return best

    def finish(
        self, model: AnyModel, evaluate: Callable[[AnyModel, Dataset], AnyReport]
    ) -> AnyReport:
        """Evaluates a model on the test part and saves it.

        Raises:
            InputError: If it cannot be evaluated or saved.
        """
        report = evaluate(model, self.test)
        if self._out is not None:
            records = self._records.get("", self._records)
            training = {
                "settings": self._settings.as_dict(),
                "optimiser": OPTIMISER_NAMES[self._settings.optimiser],
                **records,
                "fractions": self._fractions,
                "cycles": self.cycles,
            }
            save_model(
                self._out,
                model,
                {"training": training, "dataset": self._data, "held_out": report.as_dict()},
            )
            for state in self._states:
                state.remove()
        return report

    def _drawn(self, parts: Sequence[Dataset], samples: int, seed: int) -> list[Dataset]:
        """So many cycles of training and validation part together, in the proportion of both."""
        known = self._fractions[0] + self._fractions[1]
        draw = np.random.default_rng([seed, samples])
        drawn = []
        for part, fraction in zip(parts, self._fractions, strict=False):
            count = min(max(round(samples * fraction / known), 1), len(part))
            drawn.append(part.select(np.sort(draw.choice(len(part), count, replace=False))))
        return drawn

    def _state_of(self, stage: str) -> SavedState | None:
        """Where the fit of a stage is kept, under everything that its result follows from."""
        if self._out is None:
            return None
        identity = {
            "dataset": self._data["fingerprints"],
            "fractions": self._fractions,
            "kind": self._settings.kind,
            "settings": self._settings.as_dict(),
            "optimiser": OPTIMISER_NAMES[self._settings.optimiser],
            "stage": stage,
            "versions": versions(),
        }
        place = self._out.absolute()
        name = ".".join(filter(None, (f".{place.name}", stage, "training.npz")))
        state = SavedState(place.with_name(name), identity)
        self._states.append(state)
        return state
