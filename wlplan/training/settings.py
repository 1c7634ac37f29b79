"""Settings of the trainings, one class for each kind of model. Without JAX, for the command line.

Each field carries its meaning and what it may be, see `Setting`. From there come the options of
`wlplan train`, what `model.json` records, and what distinguishes one training from another.

A kind of training is a class here, in `KINDS`, and a module of the name of the kind beside this
one, with a function `train(settings, dataset, *, out, progress)`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from wlplan.errors import InputError
from wlplan.models.architecture import ACTIVATIONS, ENCODERS

LOSSES = ("huber", "squared")
"""How errors count in the loss: beyond a twentieth of the spread by their size, below that by their
square; or always by their square, as in the paper. Three cycles in a hundred stall and take far
longer than the rest. They weigh so much by the square that all others suffer: ψ_low errs by 5.9 %
in time; by Huber's loss 3.1 %.
"""

OPTIMISERS = ("adamw", "adam")
"""AdamW, its rate rising and then falling as a cosine to nothing; or Adam at a constant rate,
without weight decay, as in the paper.
"""

SPLITS = ("rollout", "cycle")
"""What a held-out part does not share with the others: the piles, or only the cycles, as in the
paper. Split by cycle, the loadings before and after one that is held out are trained on.
"""

SCALINGS = ("spread", "min-max")
"""What a network works in: units of the spread of the training data, or of their range, as in the
paper.
"""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a field of the settings means, and what it may be. Bounds of a tuple are of its entries.

    At most one of `least` and `above` is set, and at most one of `most` and `below`.
    """

    help: str
    least: int | float | None = None
    above: int | float | None = None
    most: int | float | None = None
    below: int | float | None = None
    choices: tuple[str, ...] = ()
    entries: int = 1  # most entries of a tuple

    def complaint(self, value: Any, default: Any) -> str | None:
        """What is wrong with a value, in words; None: nothing.

        Args:
            value: Value of the field.
            default: Its default, which has the type that it must have.
        """
        if isinstance(default, tuple):
            if not isinstance(value, tuple) or not 1 <= len(value) <= self.entries:
                return f"has to be a tuple of 1 to {self.entries} numbers"
            return next(filter(None, (self.complaint(each, default[0]) for each in value)), None)
        if self.choices:
            return None if value in self.choices else f"has to be one of {', '.join(self.choices)}"
        wanted: Any = (int, float) if isinstance(default, float) else int
        if isinstance(value, bool) or not isinstance(value, wanted):
            return f"has to be a {'number' if isinstance(default, float) else 'whole number'}"
        # Written so that no comparison with a number that is none holds.
        if self.least is not None and not value >= self.least:
            return f"has to be at least {self.least:g}"
        if self.above is not None and not value > self.above:
            return f"has to be more than {self.above:g}"
        if self.most is not None and not value <= self.most:
            return f"has to be at most {self.most:g}"
        if self.below is not None and not value < self.below:
            return f"has to be less than {self.below:g}"
        return None


def _setting(default: Any, help: str, **limits: Any) -> Any:
    return dataclasses.field(default=default, metadata={"setting": Setting(help, **limits)})


def _epochs(default: int) -> Any:
    help = "Passes over the training part; phi-vae makes them twice."
    return _setting(default, help, least=1, most=100_000)


def _hidden(default: tuple[int, ...]) -> Any:
    return _setting(default, "Units of each hidden layer.", least=1, most=4096, entries=8)


def _activation() -> Any:
    return _setting("swish", "Activation function.", choices=ACTIVATIONS)


def _dropout(default: float) -> Any:
    return _setting(default, "Part of the hidden units dropped in training.", least=0.0, below=1.0)


def _learning_rate(default: float) -> Any:
    return _setting(default, "Learning rate, of adamw at its peak.", above=0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What all trainings have in common.

    Attributes:
        kind: Kind of the model, as in `model.json`.

    Raises:
        InputError: If a setting is not of its type or outside its range.
    """

    kind: ClassVar[str]

    seed: int = _setting(0, "Seed of everything random but the split.", least=0, most=2**31 - 1)
    epochs: int = _epochs(150)
    batch: int = _setting(128, "Cycles a step; at most those of the training part.", least=1)
    hidden: tuple[int, ...] = _hidden((512, 512))
    dropout: float = _dropout(0.1)
    learning_rate: float = _learning_rate(2e-3)
    weight_decay: float = _setting(1e-2, "Weight decay of adamw.", least=0.0)
    optimiser: str = _setting(
        "adamw",
        "AdamW with a cosine schedule, or Adam at a constant rate, which is the paper's.",
        choices=OPTIMISERS,
    )
    patience: int = _setting(
        0,
        "Epochs without a smaller validation loss after which the training ends; 0: it never does.",
        least=0,
    )

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if complaint := setting_of(field).complaint(value, field.default):
                raise InputError(f"The setting {field.name} is {value!r}: it {complaint}.")

    def as_dict(self) -> dict[str, Any]:
        """The settings as JSON has them."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(self).items()
        }


def setting_of(field: dataclasses.Field[Any]) -> Setting:
    """What a field of settings means and may be."""
    setting: Setting = field.metadata["setting"]
    return setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class PerformanceSettings(Settings):
    """What the trainings of ψ_low and ψ_high have in common.

    An ensemble is trained with more than one member. Members share data and split, and differ in
    initial weights, order of the cycles and dropout; the interval of nine in ten cycles is fitted
    to the validation part.
    """

    activation: str = _activation()
    members: int = _setting(
        1,
        "Members; more than one make an ensemble, which predicts the deviation of its error.",
        least=1,
        most=100,
    )
    loss: str = _setting(
        "huber", "How errors count in the loss; squared is the paper's.", choices=LOSSES
    )
    split: str = _setting(
        "rollout",
        "What held-out cycles do not share with the others: a pile, or nothing, which is the "
        "paper's.",
        choices=SPLITS,
    )
    scaling: str = _setting(
        "spread",
        "Units that the network works in: spreads, or ranges, which is the paper's.",
        choices=SCALINGS,
    )
    samples: int = _setting(
        0,
        "Cycles of each data set to train and validate on, drawn at random; 0: all that are not "
        "held out.",
        least=0,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PsiLowSettings(PerformanceSettings):
    """How ψ_low is trained."""

    kind: ClassVar[str] = "psi_low"

    dropout: float = _dropout(0.02)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PsiHighSettings(PerformanceSettings):
    """How ψ_high is trained; `hidden` lies behind the encoder. The paper's has (2048, 2048)."""

    kind: ClassVar[str] = "psi_high"

    encoder: str = _setting(
        "principal",
        "Encoder of the map: the paper's convolutions, or principal components.",
        choices=ENCODERS,
    )
    mirrored: float = _setting(
        0.5,
        "Part of the maps of a step that are mirrored, left for right; the paper has none.",
        least=0.0,
        most=1.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder == "principal" and self.scaling == "min-max":
            raise InputError(
                "Principal components have no range of their own: with the scaling min-max the "
                "encoder has to be convolutional."
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhiSettings(Settings):
    """How our φ is trained."""

    kind: ClassVar[str] = "phi"

    epochs: int = _epochs(100)
    dropout: float = _dropout(0.05)
    activation: str = _activation()


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhiVaeSettings(Settings):
    """How the paper's φ is trained, in two stages with as many epochs each."""

    kind: ClassVar[str] = "phi_vae"

    epochs: int = _epochs(40)
    hidden: tuple[int, ...] = _hidden((1024, 1024))
    learning_rate: float = _learning_rate(1e-3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StallSettings(Settings):
    """How the predictor of stalls is trained."""

    kind: ClassVar[str] = "stall"

    epochs: int = _epochs(30)
    hidden: tuple[int, ...] = _hidden((128, 128, 128))
    activation: str = _activation()


KINDS: dict[str, type[Settings]] = {
    each.kind: each
    for each in (PsiLowSettings, PsiHighSettings, PhiSettings, PhiVaeSettings, StallSettings)
}
"""The settings of each kind of model that can be trained."""
