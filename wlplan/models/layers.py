"""Layers that the learned models share, in the forms that a CPU is fast at.

XLA's convolutions are slow on a CPU, backwards above all. Here a 3 × 3 convolution is nine shifted
copies of the map beside each other and one matrix product, and a change of grid is a product with a
constant matrix from either side.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.models.architecture import ACTIVATIONS

# How far outside the range of the training data an input can get, in units of that range. Our
# choice: enough for a slope or an action at the very edge of the data, not for another regime.
_MARGIN = 0.25

# Variance of an error that a network begins with, over that of the data, and the largest exponent
# by which it can differ from it: standard deviations from 0.004 to 5 of that of the data.
_USUAL_VARIANCE, _LARGEST_EXPONENT = 0.02, 7.0


class Standardiser(nnx.Module):
    """Mean and spread of the training data, to which a network scales; not trained.

    Min-max scaling alone lets a few outliers press the rest into a small part of the range, where
    a network sees and learns little.
    """

    def __init__(self, size: int):
        self.mean = nnx.BatchStat(jnp.zeros(size))
        self.spread = nnx.BatchStat(jnp.ones(size))

    def fit(self, values: Float[Array, "n k"], *, least: Float[Array, " k"] | float = 1e-3) -> None:
        """Takes mean and standard deviation of a table; no spread is less than `least`."""
        self.mean[...] = values.mean(axis=0)
        self.spread[...] = jnp.maximum(values.std(axis=0), least)

    def standardise(self, values: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """Values with mean 0 and spread 1."""
        mean, spread = self._like(values)
        return (values - mean) / spread

    def restore(self, values: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """The inverse of `standardise`."""
        mean, spread = self._like(values)
        return mean + values * spread

    def in_spreads(self, errors: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """Errors of such values in units of the spread."""
        return errors / self._like(errors)[1]

    def of_spreads(self, errors: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
        """The inverse of `in_spreads`."""
        return errors * self._like(errors)[1]

    def _like(self, values: Array) -> tuple[Array, Array]:
        # Spelt out, since ranks are never promoted silently.
        return (
            jnp.broadcast_to(self.mean[...], values.shape),
            jnp.broadcast_to(self.spread[...], values.shape),
        )


class Mlp(nnx.Module):
    """A multilayer perceptron with dropout behind each hidden layer.

    Args:
        inputs: Length of an input.
        outputs: Length of an output.
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of
            `wlplan.models.architecture.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        rngs: Random streams of the initial weights.

    Raises:
        InputError: If the architecture makes no sense.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: tuple[int, ...],
        *,
        activation: str,
        dropout: float,
        rngs: nnx.Rngs,
    ):
        activation_named(activation)
        if not hidden or min(hidden) < 1:
            raise InputError(f"The hidden layers are {hidden}: give at least one, of 1 unit up.")
        if not 0.0 <= dropout < 1.0:
            raise InputError(f"The dropout rate is {dropout:g}: it has to be in [0, 1).")
        widths = (inputs, *hidden)
        self.hidden = nnx.List(nnx.Linear(n, m, rngs=rngs) for n, m in itertools.pairwise(widths))
        self.output = nnx.Linear(widths[-1], outputs, rngs=rngs)
        # Without streams of its own it holds no state: the weights are all there is to save.
        self.dropout = nnx.Dropout(dropout)
        self.activation = activation

    def __call__(
        self, inputs: Float[Array, "*batch n"], *, rngs: nnx.Rngs | None = None
    ) -> Float[Array, "*batch m"]:
        """Outputs of the last, linear layer; `rngs` switches dropout on."""
        return self.output(self.last_hidden(inputs, rngs=rngs))

    def last_hidden(
        self, inputs: Float[Array, "*batch n"], *, rngs: nnx.Rngs | None = None
    ) -> Float[Array, "*batch k"]:
        """Outputs of the last hidden layer; `rngs` switches dropout on."""
        x = inputs
        for layer in self.hidden:
            x = activation_named(self.activation)(layer(x))
            x = self.dropout(x, deterministic=rngs is None, rngs=rngs)
        return x


class StandardisedMlp(Mlp):
    """A multilayer perceptron that works in units of the spread of the training data.

    Inputs and outputs are those of its user, in units of the range of the training data.
    `scale_in` and `scale_out` have to be fitted before it is trained.

    Args:
        inputs: Length of an input.
        outputs: Length of an output.
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of
            `wlplan.models.architecture.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        scattered: Whether a second layer of outputs predicts the variance of its errors, see
            `outputs_and_variances`.
        rngs: Random streams of the initial weights.

    Raises:
        InputError: If the architecture makes no sense.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: tuple[int, ...],
        *,
        activation: str,
        dropout: float,
        scattered: bool = False,
        rngs: nnx.Rngs,
    ):
        super().__init__(inputs, outputs, hidden, activation=activation, dropout=dropout, rngs=rngs)
        self.scatter = nnx.Linear(hidden[-1], outputs, rngs=rngs) if scattered else None
        self.scale_in = Standardiser(inputs)
        self.scale_out = Standardiser(outputs)

    def __call__(
        self, inputs: Float[Array, "*batch n"], *, rngs: nnx.Rngs | None = None
    ) -> Float[Array, "*batch m"]:
        """Outputs of the last, linear layer; `rngs` switches dropout on."""
        x = self.last_hidden(self.scale_in.standardise(inputs), rngs=rngs)
        return self.scale_out.restore(self.output(x))

    def outputs_and_variances(
        self,
        inputs: Float[Array, "*batch n"],
        *,
        rngs: nnx.Rngs | None = None,
        apart: bool = False,
    ) -> tuple[Float[Array, "*batch m"], Float[Array, "*batch m"]]:
        """Outputs, and the variances of their errors in units of their squared spread.

        Args:
            inputs: Of the network.
            rngs: Random streams of the dropout; None: without.
            apart: Whether derivatives of the variances stop at the hidden layers, as in training:
                what predicts the scatter must not make them worse at predicting the outputs.

        Raises:
            InputError: If the network has no layer for the variances.
        """
        if self.scatter is None:
            raise InputError(
                "This network does not predict the variance of its errors: train an ensemble."
            )
        x = self.last_hidden(self.scale_in.standardise(inputs), rngs=rngs)
        # Bounded, so that no step of the training can make it overflow.
        exponent = self.scatter(jax.lax.stop_gradient(x) if apart else x) / _LARGEST_EXPONENT
        variances = _USUAL_VARIANCE * jnp.exp(_LARGEST_EXPONENT * jnp.tanh(exponent))
        return self.scale_out.restore(self.output(x)), variances

    def in_spreads(self, errors: Float[Array, "*batch m"]) -> Float[Array, "*batch m"]:
        """Errors of the outputs in units of their spread."""
        return self.scale_out.in_spreads(errors)

    def of_spreads(self, errors: Float[Array, "*batch m"]) -> Float[Array, "*batch m"]:
        """The inverse of `in_spreads`."""
        return self.scale_out.of_spreads(errors)


def activation_named(name: str) -> Callable[[Array], Array]:
    """An activation function.

    Args:
        name: One of `wlplan.models.architecture.ACTIVATIONS`.

    Raises:
        InputError: If it is none of them.
    """
    if name not in ACTIVATIONS:
        raise InputError(f"Unknown activation {name!r}: choose one of {', '.join(ACTIVATIONS)}.")
    function: Callable[[Array], Array] = getattr(nnx, name)
    return function


def soft_clamp(values: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The identity on [0, 1]; outside it bends, smoothly, towards a bound a margin away.

    A planner meets slopes and curvatures that the training data never had, and a network that goes
    on linearly can promise any mass there. Held near its data it promises what it has seen; the
    gradient fades, and stays finite however far out the input is.
    """
    inside = jnp.clip(values, 0.0, 1.0)
    return inside + _MARGIN * jnp.tanh((values - inside) / _MARGIN)


def patches(maps: Float[Array, "c i j *batch"]) -> Float[Array, "k i j *batch"]:
    """The 3 × 3 neighbourhood of each cell, zero outside the map; k = 9 c.

    With the batch last, shifts and sums run along it.
    """
    rows, columns = maps.shape[1:3]
    padded = jnp.pad(maps, [(0, 0), (1, 1), (1, 1)] + [(0, 0)] * (maps.ndim - 3))
    shifts = itertools.product(range(3), repeat=2)
    return jnp.concatenate([padded[:, i : i + rows, j : j + columns] for i, j in shifts])


def max_pool(maps: Float[Array, "c i j *batch"]) -> Float[Array, "c k l *batch"]:
    """The largest of each 2 × 2 cells; where they are equal, as on flat ground, they share it."""
    rows = jnp.maximum(maps[:, ::2], maps[:, 1::2])
    return jnp.maximum(rows[:, :, ::2], rows[:, :, 1::2])


def resize(maps: Float[Array, "*batch n n"], cells: int) -> Float[Array, "*batch m m"]:
    """Square maps interpolated linearly to another number of cells, corner on corner."""
    weights = jnp.asarray(_interpolation(maps.shape[-1], cells), maps.dtype)
    return weights @ maps @ weights.T


@functools.cache
def _interpolation(before: int, after: int) -> np.ndarray:
    """Matrix that interpolates `before` points linearly at `after` points, ends on ends."""
    places = np.linspace(0.0, before - 1.0, after)
    return np.stack([np.interp(places, range(before), row) for row in np.eye(before)], axis=1)


def principal_components(rows: Float[Array, "n k"], count: int) -> Float[Array, "k m"]:
    """The directions of most variance of centred rows, orthonormal; zeros where there are no more.

    Args:
        rows: Table with mean 0 in each column.
        count: Number of components, m.
    """
    n, k = rows.shape
    # The smaller of the two squares of the table has the same eigenvalues.
    if n < k:
        values, vectors = jnp.linalg.eigh(rows @ rows.T)
        lengths = jnp.sqrt(jnp.maximum(values, 0.0))
        distinct = lengths > 1e-5 * lengths[-1]
        scale = jnp.where(distinct, 1.0 / jnp.where(distinct, lengths, 1.0), 0.0)
        vectors = rows.T @ (vectors * jnp.broadcast_to(scale, vectors.shape))
    else:
        _, vectors = jnp.linalg.eigh(rows.T @ rows)
    found = vectors[:, ::-1][:, :count]
    return jnp.pad(found, ((0, 0), (0, count - found.shape[1])))
