"""Terms of a face that is worked well: slots, headings and undercuts by hand, and gradients."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient

from wlplan.planning.face import oblique, slot, undercut
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.objective import Objective
from wlplan.site.machine import WA320
from wlplan.site.site import Site
from wlplan.site.soil import GRAVEL
from wlplan.types import Action, Performance, Pile, Pose

CELLS, CORNER = 241, -12.0
X, Y = np.meshgrid(*(CORNER + 0.1 * np.arange(CELLS),) * 2, indexing="ij")


def loading(height: np.ndarray, heading: float = 0.0) -> Loading:
    """A dig at the origin."""
    numbers = [jnp.asarray(v, jnp.result_type(float)) for v in (0.0, 0.0, heading)]
    one = numbers[0]
    return Loading(
        pile=Pile(height.astype(jnp.result_type(float)), 0.1, (CORNER, CORNER)),
        pose=Pose(*numbers),
        action=Action(one, one, one, one),
        performance=Performance(one, one, one),
        transport=Transport(one, one),
        site=Site(),
    )


def ramp(degrees: float = 30.0) -> np.ndarray:
    """A face along y, uphill towards +x from the origin on."""
    face: np.ndarray = np.maximum(X * math.tan(math.radians(degrees)), 0.0)
    return face


@pytest.mark.parametrize(
    ("sides", "metres"), [((), 0.0), ((1.0,), 0.0), ((-1.0,), 0.0), ((1.0, -1.0), 3.0)]
)
def test_a_slot_has_soil_on_both_sides(sides: tuple[float, ...], metres: float) -> None:
    """Ridges 3 m long, half a metre beside the bucket."""
    height = ramp()
    for side in sides:
        height[(X > -4.0) & (X < -1.0) & (np.abs(Y - side * 1.85) < 0.2)] = 0.8
    assert float(slot(loading(height))) == pytest.approx(metres, abs=0.5)
    far = ramp()
    far[(X < -1.0) & (np.abs(Y) > WA320.bucket_width + 0.2)] = 0.8
    assert float(slot(loading(far))) == 0.0


@pytest.mark.parametrize("degrees", [-60.0, -20.0, 0.0, 30.0])
def test_oblique_is_one_less_the_cosine(degrees: float) -> None:
    """A plane that fills the map in front of the bucket."""
    plane = 5.0 + X * math.tan(math.radians(30.0))
    turned = loading(plane, math.radians(degrees))
    expected = 1.0 - math.cos(math.radians(degrees))
    assert float(oblique(turned)) == pytest.approx(expected, abs=2e-3)


def test_an_undercut_face_is_high_and_steep() -> None:
    reach = WA320.pivot_height + WA320.boom_length
    high, wall = 7.0, 0.5
    # At repose it may be as high as it is.
    rest = np.clip(X * math.tan(GRAVEL.repose_angle), 0.0, high)
    assert float(undercut(loading(rest))) == 0.0
    # Steep, but within reach.
    low = np.where(wall < X, reach - 0.2, 0.0)
    assert float(undercut(loading(low))) == 0.0
    steep = np.where(wall < X, high, 0.0)
    assert float(undercut(loading(steep))) == pytest.approx(high - reach, abs=0.05)


def test_gradients_against_finite_differences() -> None:
    with jax.enable_x64(True):
        rough = ramp(40.0) + 0.33 * np.exp(-((X + 2.0) ** 2 + (np.abs(Y) - 1.9) ** 2) / 4.0)
        rough += np.where(X > 0.0, 0.3 * np.sin(1.3 * Y), 0.0)
        rough = np.where(X > 1.0, rough + 4.0, rough)
        terms = {"slot": 1.0, "oblique": 3.0, "undercut": 0.5}
        objective, base = Objective(terms), loading(rough)

        def cost(place: jax.Array) -> jax.Array:
            return objective(base.replace(pose=Pose(*place)))

        at = jnp.array([0.13, 0.21, 0.2])
        values = objective.values(base.replace(pose=Pose(*at)))
        assert all(float(value) > 0.003 for value in values.values())
        assert_gradient(cost, at)
