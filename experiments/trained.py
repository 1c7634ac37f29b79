"""Models that experiments need, kept in a folder: what was trained once is not trained again."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax

from wlplan import training
from wlplan.dataset import Dataset, fingerprint
from wlplan.errors import InputError
from wlplan.io import write_text_atomic
from wlplan.models.ensemble import Ensemble
from wlplan.worlds.library import pretrained_path

# Passes over the data with which the paper's ψ_high is trained: 9 s of processor time each.
CONVOLUTIONAL_EPOCHS = 60
PSI = {
    "psi_low, swish": {"kind": "psi_low", "activation": "swish"},
    "psi_low, leaky relu": {"kind": "psi_low", "activation": "leaky_relu"},
    "psi_low of the paper, swish": {
        "kind": "psi_low",
        "activation": "swish",
        "loss": "squared",
    },
    "psi_high, swish": {"kind": "psi_high", "activation": "swish"},
    "psi_high, leaky relu": {"kind": "psi_high", "activation": "leaky_relu"},
    **{
        f"psi_high of the paper, {title}": {
            "kind": "psi_high",
            "activation": activation,
            "encoder": "convolutional",
            "hidden": (2048, 2048),
            "epochs": CONVOLUTIONAL_EPOCHS,
            "loss": "squared",
        }
        for title, activation in (("swish", "swish"), ("leaky relu", "leaky_relu"))
    },
}
"""The performance predictors that are compared: kind and settings, by title."""
SHORT: dict[str, Any] = {"epochs": 2, "hidden": (32,)}
"""What a smoke preset changes of the settings."""
SHIPPED = {f"{kind}, as it ships": kind for kind in ("psi_low", "psi_high")}
"""The performance predictors that ship, trained on more cycles than a data set has: kind, by title.

The held-out cycles of the data set are new to them too.
"""


def shipped(kind: str) -> tuple[Ensemble, dict[str, Any]]:
    """An ensemble that ships, and its description."""
    place = pretrained_path(kind)
    model = training.load_model(place, kind)
    assert isinstance(model, Ensemble)
    return model, training.read_description(place, kind)


def trained(
    models: Path, data: Dataset, kind: str, *, seed: int = 0, **settings: Any
) -> tuple[Any, float | None]:
    """A model of these settings on this data set, from the folder, or trained into it.

    Cut short, the same call goes on where it was.

    Args:
        models: Folder of models; one of other data or settings has another name.
        data: Data set to train on.
        kind: "psi_low", "psi_high", "phi" or "phi_vae".
        seed: Seed of the training.
        settings: Further arguments of the function that trains it.

    Returns:
        The model, and how long training took [s]; None if it did not run in one go.
    """
    train = getattr(training, f"train_{kind}")
    # What is not named may change with the code: another default is another model.
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(train).parameters.items()
        if parameter.default is not parameter.empty
    }
    recipe = hashlib.sha256(repr(sorted(defaults.items())).encode()).hexdigest()
    words = [kind, fingerprint(data).removeprefix("sha256:")[:8], recipe[:4], f"seed{seed}"]
    # Whoever names a default and whoever does not share a model.
    for name, value in sorted((n, v) for n, v in settings.items() if v != defaults.get(n)):
        text = "x".join(map(str, value)) if isinstance(value, tuple) else str(value)
        words.append(f"{name}-{text}")
    folder = models / "_".join(words)
    timing = models / f"{folder.name}.time.json"
    with contextlib.suppress(InputError):
        model = training.load_model(folder, kind)
        return model, json.loads(timing.read_text())["training_s"] if timing.is_file() else None
    begun = timing.is_file()
    models.mkdir(parents=True, exist_ok=True)
    write_text_atomic(timing, json.dumps({"training_s": None}))
    print(f"training {folder.name}", file=sys.stderr, flush=True)
    start = time.perf_counter()
    model, _ = train(data, out=folder, seed=seed, **settings)
    seconds = None if begun else time.perf_counter() - start
    write_text_atomic(timing, json.dumps({"training_s": seconds}))
    jax.clear_caches()
    return model, seconds
