"""A law of every training: killed, it goes on where it was and ends with the same weights."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from wlplan.dataset import Dataset
from wlplan.training import Settings, fitting, train


class KilledError(Exception):
    """What ends a training in the middle."""


def check_that_a_killed_one_ends_alike(
    data: Dataset, folder: Path, monkeypatch: pytest.MonkeyPatch, settings: Settings, **other: Any
) -> None:
    """Trains whole, and killed after two of four epochs and again.

    Args:
        data: Data set.
        folder: Folder to write to.
        monkeypatch: Of the test.
        settings: Of the training, with four epochs.
        other: Settings in which another training differs, which takes nothing over.
    """
    monkeypatch.setattr(fitting, "_SAVE_EVERY", 0.0)
    whole, _ = train(settings, data, out=folder / "whole")

    def killed(done: int, _: int) -> None:
        if done == 2:
            raise KilledError

    def epochs(settings: Settings) -> tuple[Any, list[tuple[int, ...]]]:
        seen = []
        model, _ = train(settings, data, out=folder / "m", progress=lambda *n: seen.append(n))
        return model, seen

    with pytest.raises(KilledError):
        train(settings, data, out=folder / "m", progress=killed)
    assert (folder / ".m.training.npz").exists()
    resumed, seen = epochs(settings)
    assert seen == [(3, 4), (4, 4)]
    for got, want in zip(jax.tree.leaves(resumed), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(got, want)

    with pytest.raises(KilledError):
        train(settings, data, out=folder / "m", progress=killed)
    assert len(epochs(dataclasses.replace(settings, **other))[1]) == 4
