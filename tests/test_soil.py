"""The earthmoving equation: the oracle of the design, its own minimum, laws, gradients."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient

from wlplan.constants import GRAVITY
from wlplan.engines.simulator.soil import least_resistance, wedge_of
from wlplan.site.soil import GRAVEL, Soil

# Depths, rakes, slopes and external frictions.
Cuts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

# Design, section 5: rake 60, external friction 20, internal friction 35 degrees, flat ground.
ORACLE = Soil(density=1800.0, friction=math.radians(35.0), steel_friction=math.radians(20.0))
STICKY = dataclasses.replace(ORACLE, cohesion=10e3, adhesion=5e3)
RAKE, DEPTH = math.radians(60.0), 0.5


def documented(
    depth: float,
    rake: float,
    slope: float,
    *,
    soil: Soil,
    external_friction: float,
    surcharge: float = 0.0,
    trials: int = 4001,
) -> tuple[float, float, float]:
    """The equation of the module's docstring at many failure angles, in numpy.

    Returns the least force [N/m], the failure angle [rad] and N_gamma there.
    """
    phi, delta = soil.friction, external_friction
    beta = np.radians(np.linspace(0.5, 89.0, trials))
    eta = delta + rake + phi + beta
    beta, eta = beta[eta < np.pi - 1e-3], eta[eta < np.pi - 1e-3]
    n_q = (1 / np.tan(rake) + 1 / np.tan(beta)) * np.sin(slope + phi + beta) / np.sin(eta)
    n_c = np.cos(phi) / (np.sin(beta) * np.sin(eta))
    n_a = -np.cos(rake + phi + beta) / (np.sin(rake) * np.sin(eta))
    force = (soil.density * GRAVITY * depth**2 / 2 + surcharge * depth) * n_q
    force = force + (soil.cohesion * n_c + soil.adhesion * n_a) * depth
    best = force.argmin()
    return force[best], beta[best], n_q[best] / 2


@pytest.fixture(scope="module")
def random_cuts() -> Cuts:
    """Depth [m], rake, slope and external friction [rad] as a bucket meets them."""
    rng = np.random.default_rng(0)
    slope = np.radians(rng.uniform(-10.0, 31.0, 400))
    # The rake is the blade's inclination, which is not negative, plus the slope.
    rake = rng.uniform(np.maximum(np.radians(12.0), slope), np.radians(80.0))
    friction = np.radians(rng.uniform(15.0, 32.0, 400))
    return rng.uniform(0.02, 1.5, 400), rake, slope, friction


def earthmoving_force(
    depth: jax.Array,
    rake: jax.Array,
    slope: jax.Array,
    *,
    soil: Soil,
    external_friction: Any = None,
    surcharge: float = 0.0,
) -> jax.Array:
    """Force on a blade a metre of width [N/m], as the simulator computes it."""
    friction = soil.steel_friction if external_friction is None else external_friction
    wedge = wedge_of(depth, rake, slope, friction, soil=soil, surcharge=surcharge)
    return least_resistance(wedge, soil=soil)


run: Callable[..., jax.Array] = jax.jit(earthmoving_force, static_argnames=("soil", "surcharge"))


def forces(cuts: Sequence[np.ndarray], soil: Soil, surcharge: float = 0.0) -> np.ndarray:
    depth, rake, slope, friction = (jnp.asarray(v, jnp.float32) for v in cuts)
    force = run(depth, rake, slope, external_friction=friction, soil=soil, surcharge=surcharge)
    return np.asarray(force)


def at(depth: float, rake: float, slope: float, **options: Any) -> jax.Array:
    return run(jnp.asarray(depth), jnp.asarray(rake), jnp.asarray(slope), **options)


@pytest.mark.parametrize(("soil", "kilonewton"), [(ORACLE, 8.0), (STICKY, 25.1)])
def test_the_oracle_on_flat_ground(soil: Soil, kilonewton: float) -> None:
    assert at(DEPTH, RAKE, 0.0, soil=soil) == pytest.approx(kilonewton * 1e3, rel=6e-3)
    force, _, _ = documented(
        DEPTH, RAKE, 0.0, soil=soil, external_friction=soil.steel_friction, trials=40001
    )
    assert at(DEPTH, RAKE, 0.0, soil=soil) == pytest.approx(force, rel=1e-4)


def test_the_failure_angle_of_the_oracle() -> None:
    _, angle, n_gamma = documented(
        DEPTH, RAKE, 0.0, soil=ORACLE, external_friction=ORACLE.steel_friction, trials=40001
    )
    assert math.degrees(angle) == pytest.approx(28.1, abs=0.05)
    assert n_gamma == pytest.approx(1.82, abs=5e-3)


@pytest.mark.parametrize(
    "soil",
    [
        GRAVEL,
        dataclasses.replace(GRAVEL, cohesion=10e3, adhesion=5e3),
        dataclasses.replace(GRAVEL, density=1500.0, cohesion=1e3),
        # Steep friction brings the wedge close to locking.
        dataclasses.replace(GRAVEL, friction=math.radians(38.0)),
        dataclasses.replace(GRAVEL, friction=math.radians(42.0)),
    ],
)
@pytest.mark.parametrize("surcharge", [0.0, 5e3])
def test_it_is_the_minimum_over_the_failure_angle(
    soil: Soil, surcharge: float, random_cuts: Cuts
) -> None:
    reference = [
        documented(d, r, s, soil=soil, external_friction=f, surcharge=surcharge)[0]
        for d, r, s, f in zip(*random_cuts, strict=True)
    ]
    np.testing.assert_allclose(forces(random_cuts, soil, surcharge), reference, rtol=5e-3)


def test_without_cohesion_it_is_coulombs_passive_pressure() -> None:
    """Coulomb's closed form, the surface turned level: same wedge, same plane of failure."""
    phi = ORACLE.friction
    for degrees in ((60, 0, 20), (80, 0, 20), (60, 0, 10), (60, 20, 20), (55, -8, 25)):
        rake, slope, delta = (math.radians(v) for v in degrees)
        # The back of the wall stands at this angle over the horizontal, this high.
        wall = rake - slope
        rise = DEPTH / math.sin(rake) * math.sin(wall)
        root = math.sqrt(
            math.sin(phi + delta)
            * math.sin(phi + slope)
            / (math.sin(wall + delta) * math.sin(wall + slope))
        )
        passive = math.sin(wall - phi) ** 2 / (
            math.sin(wall) ** 2 * math.sin(wall + delta) * (1 - root) ** 2
        )
        coulomb = 0.5 * ORACLE.density * GRAVITY * rise**2 * passive
        force = at(DEPTH, rake, slope, soil=ORACLE, external_friction=delta)
        assert force == pytest.approx(coulomb, rel=1e-3)


def test_deeper_is_harder_and_the_surface_is_free(random_cuts: Cuts) -> None:
    depth, *rest = random_cuts
    for soil in (ORACLE, STICKY):
        shallow, deep = forces((depth, *rest), soil), forces((1.1 * depth, *rest), soil)
        assert (deep > shallow).all()
        assert (forces((0.0 * depth, *rest), soil) == 0.0).all()
        assert (shallow > 0.0).all()


def test_it_scales_as_the_equation_does(random_cuts: Cuts) -> None:
    depth, *rest = random_cuts
    base = forces(random_cuts, GRAVEL)
    heavy = forces(random_cuts, dataclasses.replace(GRAVEL, density=2 * GRAVEL.density))
    np.testing.assert_allclose(heavy, 2 * base, rtol=1e-5)
    np.testing.assert_allclose(forces((3 * depth, *rest), GRAVEL), 9 * base, rtol=1e-5)
    # A surcharge counts like half its own depth of soil.
    weight = GRAVEL.density * GRAVITY
    loaded = forces((np.full_like(depth, 0.5), *rest), GRAVEL, weight * 0.5 / 2)
    plain = forces((np.full_like(depth, 0.5), *rest), GRAVEL)
    np.testing.assert_allclose(loaded, 2 * plain, rtol=1e-5)


def test_cohesion_adds_resistance(random_cuts: Cuts) -> None:
    sticky = dataclasses.replace(GRAVEL, cohesion=1e3)
    assert (forces(random_cuts, sticky) > forces(random_cuts, GRAVEL)).all()


def test_lanes_are_independent(random_cuts: Cuts) -> None:
    together = forces(random_cuts, GRAVEL)
    for k in (0, 17):
        depth, rake, slope, friction = (v[k] for v in random_cuts)
        alone = at(depth, rake, slope, soil=GRAVEL, external_friction=float(friction))
        assert alone == pytest.approx(together[k], rel=1e-5)


def gradient_case(
    cuts: Cuts, pick: list[int]
) -> tuple[Callable[[jax.Array], jax.Array], jax.Array]:
    """Force as a function of the picked inputs of a few cuts, and those inputs."""
    point = jnp.asarray(np.stack([v[:4] for v in cuts]))

    def force(picked: jax.Array) -> jax.Array:
        full = point.at[jnp.asarray(pick)].set(picked)
        total: jax.Array = run(*full[:3], soil=GRAVEL, external_friction=full[3]).sum() / 1e3
        return total

    return force, point[jnp.asarray(pick)]


def test_gradient_in_depth_against_finite_differences(random_cuts: Cuts) -> None:
    with jax.enable_x64(True):
        assert_gradient(*gradient_case(random_cuts, [0]), relative=1e-6)


def test_gradient_in_angles_against_finite_differences(random_cuts: Cuts) -> None:
    """The failure angle counts as a constant, so this is as good as the angle is."""
    with jax.enable_x64(True):
        assert_gradient(*gradient_case(random_cuts, [1, 2, 3]), relative=3e-3)


def test_gradients_are_finite_at_the_surface_and_beyond_locking() -> None:
    both = jax.jit(
        jax.value_and_grad(lambda p: run(*p, soil=GRAVEL, external_friction=GRAVEL.friction))
    )
    for depth, rake, slope in ((0.0, 1.0, 0.0), (0.5, math.radians(80), math.radians(35))):
        value, gradient = both([jnp.asarray(v) for v in (depth, rake, slope)])
        assert np.isfinite([value, *gradient]).all()
