"""Models that experiments need, saved in a folder: each is trained once, then loaded."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import jax

from experiments._common.places import say
from wlplan import training
from wlplan.dataset import Dataset, fingerprint
from wlplan.errors import InputError
from wlplan.io import write_text_atomic
from wlplan.models.ensemble import Ensemble
from wlplan.models.storage import load_model, read_description
from wlplan.training.settings import (
    PerformanceSettings,
    PsiHighSettings,
    PsiLowSettings,
    Settings,
)
from wlplan.worlds.shipped import pretrained_path

# Passes over the data with which the paper's ψ_high is trained: 9 s of processor time each.
CONVOLUTIONAL_EPOCHS = 60
PREDICTORS: dict[str, PerformanceSettings] = {
    "psi_low, swish": PsiLowSettings(),
    "psi_low, leaky relu": PsiLowSettings(activation="leaky_relu"),
    "psi_low of the paper, swish": PsiLowSettings(loss="squared"),
    "psi_high, swish": PsiHighSettings(),
    "psi_high, leaky relu": PsiHighSettings(activation="leaky_relu"),
    **{
        f"psi_high of the paper, {title}": PsiHighSettings(
            activation=activation,
            encoder="convolutional",
            hidden=(2048, 2048),
            epochs=CONVOLUTIONAL_EPOCHS,
            loss="squared",
        )
        for title, activation in (("swish", "swish"), ("leaky relu", "leaky_relu"))
    },
}
"""The performance predictors that are compared: settings, by title."""
PRETRAINED = {f"{kind}, as it ships": kind for kind in ("psi_low", "psi_high")}
"""The performance predictors that ship, trained on more cycles than a data set has: kind, by title.

The held-out cycles of the data set are new to them too.
"""


def smoke_settings(settings: Settings) -> Settings:
    """The settings with which a smoke preset trains in seconds."""
    return dataclasses.replace(settings, epochs=2, hidden=(32,))


def load_pretrained(kind: str) -> tuple[Ensemble, dict[str, Any]]:
    """The ensemble of a kind that ships with the package, and its description."""
    place = pretrained_path(kind)
    model = load_model(place, kind)
    assert isinstance(model, Ensemble)
    return model, read_description(place, kind)


def load_or_train(models: Path, data: Dataset, settings: Settings) -> tuple[Any, float | None]:
    """A model of these settings on this data set, loaded from a folder, or trained into it.

    Cut short, the same call goes on where it was.

    Args:
        models: Folder of models; one of other data or settings has another name.
        data: Data set to train on.
        settings: How it is trained.

    Returns:
        The model, and how long training took [s]; None if it did not run in one go.
    """
    # All settings, also those that are not named: another default is another model.
    every = json.dumps(settings.as_dict(), sort_keys=True)
    mark = hashlib.sha256(every.encode()).hexdigest()[:8]
    words = [settings.kind, fingerprint(data).removeprefix("sha256:")[:8], mark]
    for field in dataclasses.fields(settings):
        if (value := getattr(settings, field.name)) != field.default:
            text = "x".join(map(str, value)) if isinstance(value, tuple) else str(value)
            words.append(f"{field.name}-{text}")
    folder = models / "_".join(words)
    timing = models / f"{folder.name}.time.json"
    with contextlib.suppress(InputError):
        model = load_model(folder, settings.kind)
        return model, json.loads(timing.read_text())["training_s"] if timing.is_file() else None
    begun = timing.is_file()
    models.mkdir(parents=True, exist_ok=True)
    write_text_atomic(timing, json.dumps({"training_s": None}))
    say(f"training {folder.name}")
    start = time.perf_counter()
    model, _ = training.train(settings, data, out=folder)
    seconds = None if begun else time.perf_counter() - start
    write_text_atomic(timing, json.dumps({"training_s": seconds}))
    jax.clear_caches()
    return model, seconds
