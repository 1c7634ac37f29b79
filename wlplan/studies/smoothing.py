"""Gradients of a function smoothed by a normal distribution, and how rough a function is.

What a planner wants to know is where a function falls over the length of its steps. The derivative
at one point does not say so if the function is rough. That of the smoothed function
E f(x + w z), z ~ N(0, 1), does, and can be had in two ways. *Zeroth order* needs values alone; it
sees jumps. *First order* is the mean of exact derivatives; it does not see jumps, and has little
variance where the function is smooth. *Mixed* weighs both by their variance: Suh, Simchowitz, Zhang
and Tedrake, "Do differentiable simulators give better policy gradients?", ICML 2022.
"""

from __future__ import annotations

import functools
import math
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int

from wlplan.errors import InputError
from wlplan.studies.variables import Function, as_function, jacobians_at, values_at

ORDERS = ("zeroth", "first", "mixed")
"""What a gradient is made of: values, derivatives, or both."""

BIAS = 2.0
"""How far a mixed gradient may be drawn from the zeroth-order one, in standard errors of that."""


@no_type_check
class SmoothedGradient(struct.PyTreeNode):
    """An estimate of the gradient of a smoothed function of D variables, for each of its values."""

    gradient: Float[Array, "*k d"]
    variance: Float[Array, "*k"]  # of the estimate, summed over the variables
    first_share: Float[Array, "*k"]  # weight of the first-order estimate in it [1]


def smoothed_gradient(
    function: Function,
    at: Float[Array | np.ndarray, " d"],
    *,
    width: float | Float[Array, ""],
    pairs: int = 16,
    order: str = "mixed",
    bias: float = BIAS,
    seed: int | Int[Array, ""] = 0,
) -> SmoothedGradient:
    """The gradient of E f(at + width z), z normal, from pairs of opposite samples.

    Pure, and compiled once for each kind of function. In a quadratic function all orders are exact.

    Args:
        function: Of an array [d] to an array.
        at: Where.
        width: Standard deviation of the samples, the same for all variables.
        pairs: Of samples. Zeroth order evaluates both, first order differentiates at both, mixed
            does either.
        order: "zeroth": least squares over the differences of pairs, which is the score function
            with its samples' own covariance in place of the expected one. "first": the mean of
            derivatives. "mixed": see `mixed_order`.
        bias: As of `mixed_order`.
        seed: Of the samples.

    Raises:
        InputError: If there is no such order, the width is not positive, or there are no more
            pairs than variables, of which nothing can be said about the variance.
    """
    if order not in ORDERS:
        raise InputError(f"there is no order {order!r}: give one of {', '.join(ORDERS)}.")
    if pairs <= len(at):
        raise InputError(f"{pairs} pairs are too few for {len(at)} variables: give more pairs.")
    if isinstance(width, int | float) and not 0.0 < width < math.inf:
        raise InputError(f"the width is {width:g}: it has to be positive.")
    found: SmoothedGradient = _smoothed_gradient(
        as_function(function), jnp.asarray(at), width, seed, bias, pairs=pairs, order=order
    )
    return found


@functools.partial(jax.jit, static_argnames=("pairs", "order"))
def _smoothed_gradient(
    function: Function,
    at: Array,
    width: Array,
    seed: Array,
    bias: Array,
    *,
    pairs: int,
    order: str,
) -> SmoothedGradient:
    samples = jax.random.normal(jax.random.key(seed), (pairs, len(at)), at.dtype)
    if order == "zeroth":
        return _zeroth_order(function, at, width, samples)
    first = _first_order(function, at, width, samples)
    if order == "first":
        return first
    return mixed_order(_zeroth_order(function, at, width, samples), first, bias=bias)


def _opposites(at: Array, width: Array, samples: Array) -> Array:
    """Points on either side, [2 n, d]."""
    here, away = jnp.broadcast_to(at, samples.shape), width * samples
    return jnp.concatenate([here + away, here - away])


def _zeroth_order(
    function: Function, at: Array, width: Array, samples: Float[Array, "n d"]
) -> SmoothedGradient:
    count, dimensions = samples.shape
    ahead, behind = jnp.split(values_at(function, _opposites(at, width, samples)), 2)
    kind = ahead.shape[1:]
    rise = ((ahead - behind) / (2.0 * width)).reshape(count, -1)
    inverse = jnp.linalg.inv(samples.T @ samples)
    gradient = inverse @ (samples.T @ rise)
    rest = ((rise - samples @ gradient) ** 2).sum(axis=0) / (count - dimensions)
    return SmoothedGradient(
        gradient=gradient.T.reshape(*kind, dimensions),
        variance=(rest * jnp.trace(inverse)).reshape(kind),
        first_share=jnp.zeros(kind, at.dtype),
    )


def _first_order(
    function: Function, at: Array, width: Array, samples: Float[Array, "n d"]
) -> SmoothedGradient:
    ahead, behind = jnp.split(jacobians_at(function, _opposites(at, width, samples)), 2)
    # A pair is one sample: its two halves are not independent.
    pairs = 0.5 * (ahead + behind)
    return SmoothedGradient(
        gradient=pairs.mean(axis=0),
        variance=pairs.var(axis=0, ddof=1).sum(axis=-1) / len(samples),
        first_share=jnp.ones(pairs.shape[1:-1], at.dtype),
    )


def mixed_order(
    zeroth: SmoothedGradient, first: SmoothedGradient, *, bias: float | Array = BIAS
) -> SmoothedGradient:
    """Both estimates weighed by their variance, as far as the first is not plainly biased.

    At a jump the first-order estimate is wrong and has no variance to tell. So the mixture keeps
    within `bias` standard errors of the zeroth-order estimate, which is right on average.

    Args:
        zeroth: Estimate of zeroth order.
        first: Of first order, of the same function.
        bias: Standard errors. Infinite: by the variance alone.
    """
    both = zeroth.variance + first.variance
    share = jnp.where(both > 0.0, zeroth.variance / jnp.where(both > 0.0, both, 1.0), 1.0)
    apart = jnp.sqrt(((first.gradient - zeroth.gradient) ** 2).sum(axis=-1))
    error = jnp.sqrt(zeroth.variance)
    # Not a product of the bias: infinitely many times no error is no number.
    within = share * apart <= bias * error
    share = jnp.where(within, share, bias * error / jnp.where(apart > 0.0, apart, 1.0))
    weight = share[..., None]
    return SmoothedGradient(
        gradient=weight * first.gradient + (1.0 - weight) * zeroth.gradient,
        variance=share**2 * first.variance + (1.0 - share) ** 2 * zeroth.variance,
        first_share=share,
    )


@no_type_check
class Roughness(struct.PyTreeNode):
    """How a function deviates from a parabola over W widths around a point."""

    width: Float[Array, " w"]
    slope: Float[Array, "w ..."]  # of the parabola, where the width is 0
    spread: Float[Array, "w ..."]  # standard deviation of the values
    rest: Float[Array, "w ..."]  # that of what the parabola leaves

    @property
    def share(self) -> Float[np.ndarray, "w ..."]:
        """Part of the variance that is no parabola [1]; 0 where nothing varies."""
        spread, rest = (np.asarray(part, float) for part in (self.spread, self.rest))
        share: np.ndarray = np.where(spread > 0.0, rest / np.where(spread > 0.0, spread, 1.0), 0.0)
        return share**2


def roughness(
    function: Function,
    at: Float[Array | np.ndarray, "*d"],
    along: Float[Array | np.ndarray, "*d"],
    widths: Float[Array | np.ndarray, " w"],
    *,
    samples: int = 16,
) -> Roughness:
    """How rough a function is along a line, against the width that it is looked at with.

    Of each width, values at the quantiles of a normal distribution, and their best parabola. As
    the width shrinks, the rest of a smooth function shrinks with its third power, that of a kink
    with the first, and that of a jump stays.

    Pure, and compiled once for each kind of function and number of widths and samples.

    Args:
        function: Of an array to an array.
        at: Where.
        along: Direction; a width of 1 has its length.
        widths: Standard deviations of the samples.
        samples: Of each width.

    Raises:
        InputError: If there are fewer than four samples, through which there is always a parabola.
    """
    if samples < 4:
        raise InputError(f"{samples} samples say nothing of a parabola: ask for at least 4.")
    found: Roughness = _roughness(
        as_function(function), *map(jnp.asarray, (at, along, widths)), samples=samples
    )
    return found


@functools.partial(jax.jit, static_argnames="samples")
def _roughness(
    function: Function, at: Array, along: Array, widths: Array, *, samples: int
) -> Roughness:
    place = norm.ppf((jnp.arange(samples, dtype=widths.dtype) + 0.5) / samples)
    away = (widths[:, None] * place[None]).reshape(-1)
    values = values_at(function, jax.vmap(lambda a: at + a * along)(away))
    kind = values.shape[1:]
    table = values.reshape(len(widths), samples, -1)
    table = table - table.mean(axis=1, keepdims=True)
    basis = jnp.stack([jnp.ones_like(place), place, place**2], axis=1)
    weights = jnp.linalg.pinv(basis) @ table
    rest = table - basis @ weights

    def deviation(part: Array, spent: int) -> Array:
        root: Array = jnp.sqrt((part**2).sum(axis=1) / (samples - spent))
        return root.reshape(-1, *kind)

    slope = (weights[:, 1] / widths[:, None]).reshape(-1, *kind)
    return Roughness(widths, slope, deviation(table, 1), deviation(rest, basis.shape[1]))
