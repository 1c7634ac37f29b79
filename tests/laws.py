"""Laws that hold for every stage, as assertions; tests/test_laws.py shows that they can fail."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from wlplan.types import Pile


def volume(pile: Pile) -> jax.Array:
    """Volume between the surface and the floor [m^3]; signed, and linear in the height."""
    return jnp.sum(pile.height - pile.floor, axis=(-2, -1)) * pile.cell_size**2


def assert_volume_kept(before: ArrayLike, after: ArrayLike, *, relative: float = 1e-6) -> None:
    """The summed height is the same to `relative` of the total."""
    was, now = (float(np.asarray(height, np.float64).sum()) for height in (before, after))
    assert abs(now - was) <= relative * abs(was), f"the volume changed from {was:.9g} to {now:.9g}"


def assert_no_soil_from_nowhere(
    before: Pile,
    after: Pile,
    mass: float,
    *,
    density: float,
    relative: float = 1e-6,
    absolute: float = 1e-6,
) -> float:
    """A load is what left the pile, apart from rounding; it is not negative, nor dug deeper.

    Args:
        before: Pile before the load.
        after: Pile after it.
        mass: Of the load [tonne].
        density: Of the soil [tonne/m^3].
        relative: Largest part of the mass of the pile that may be off.
        absolute: Largest mass that may be off anyway [tonne].

    Returns:
        What is off [tonne].
    """
    surfaces = [np.asarray(pile.height, np.float64) for pile in (before, after)]
    floor = np.asarray(before.floor, np.float64)
    was, now = (density * float((s - floor).sum()) * before.cell_size**2 for s in surfaces)
    assert mass >= 0.0, f"the load has a mass of {mass:g} t"
    off = abs(was - now - mass)
    bound = max(relative * was, absolute)
    assert off <= bound, f"{was - now:.9g} t left the pile, {mass:.9g} t were got"
    dug = float((surfaces[1] - floor).min())
    assert dug >= -1e-6, f"it is dug {-dug:g} m below its floor"
    return off


def assert_gradient(
    function: Callable[[Any], jax.Array],
    point: Any,
    *,
    step: float = 1e-6,
    relative: float = 1e-4,
    absolute: float = 0.0,
    skip: int | None = None,
) -> int:
    """Reverse mode agrees with central differences, component by component, in float64.

    Args:
        function: Scalar function of a pytree.
        point: Where to compare; float64 leaves.
        step: Of the central difference.
        relative: Largest error over the larger of the two, or over the largest component.
        absolute: Errors below this count as none.
        skip: Largest number of components that may disagree because a kink lies within `step`:
            one whose two one-sided differences disagree. None: no component may.

    Returns:
        The number of components at kinks.
    """
    leaves, tree = jax.tree.flatten(point)
    sizes = [leaf.size for leaf in leaves]
    flat = np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in leaves])

    def value(vector: jax.Array) -> jax.Array:
        parts = np.split(vector, np.cumsum(sizes)[:-1])
        pairs = zip(parts, leaves, strict=True)
        rebuilt = [jnp.asarray(p.reshape(leaf.shape)) for p, leaf in pairs]
        return function(jax.tree.unflatten(tree, rebuilt))

    # One program for both: it takes longer to compile than to run.
    both = jax.jit(jax.value_and_grad(value))

    def compiled(vector: np.ndarray) -> float:
        return float(both(vector)[0])

    exact = np.asarray(both(flat)[1])
    assert np.isfinite(exact).all(), "the gradient is not finite"
    here = compiled(flat)
    kinks, errors = 0, []
    scale = np.abs(exact).max()
    for k in range(flat.size):
        ahead, behind = flat.copy(), flat.copy()
        ahead[k] += step
        behind[k] -= step
        up, down = compiled(ahead), compiled(behind)
        central = (up - down) / (2 * step)
        error = abs(central - exact[k])
        bound = max(relative * max(abs(central), abs(exact[k]), 1e-3 * scale), absolute)
        if error > bound:
            one_sided = abs((up - here) - (here - down)) / step
            if skip is not None and one_sided > 0.5 * error:
                kinks += 1
                continue
            errors.append((k, float(exact[k]), central))
    assert not errors, f"gradient and central difference differ: {errors[:5]}"
    assert skip is None or kinks <= skip, f"{kinks} components at kinks, {skip} allowed"
    return kinks
