"""What the pictures of the paper's figures rest on: kept grids, the machine, the networks."""

import itertools
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from experiments import architectures
from experiments._common.grids import around_pile, packed, unpacked
from experiments._common.side_view import Stance, bucket_inside, content_outline
from experiments.characteristics_picture import mean_normal
from wlplan.constants import CELL_SIZE
from wlplan.engines.simulator.loader import bucket_tip
from wlplan.models.phi import HeightChange
from wlplan.models.phi_vae import PhiVae
from wlplan.models.psi_high import PsiHigh
from wlplan.models.psi_low import PsiLow
from wlplan.site.machine import WA320
from wlplan.terrain.characteristics import characteristics
from wlplan.types import LocalHeightmap

# --- heights in a result


def test_heights_are_kept_to_the_centimetre_in_few_bytes() -> None:
    random = np.random.default_rng(0)
    smooth = np.cumsum(random.normal(scale=0.02, size=(60, 50)), axis=0)
    grids = np.stack([smooth] * 9)
    grids[4:, 10:15, 20:25] -= 0.5
    value = json.loads(json.dumps(packed(grids)))
    found = unpacked(value)
    assert found.shape == grids.shape
    np.testing.assert_allclose(found, grids, atol=0.005 + 1e-9)
    assert len(json.dumps(value)) < grids.size / 4


def test_the_part_around_a_pile_holds_all_soil_of_all_grids() -> None:
    grids = np.zeros((2, 30, 40))
    grids[0, 5, 7], grids[1, 20, 30] = 1.0, 1.0
    part, (row, column) = around_pile(grids, 3)
    assert (row, column) == (2, 4)
    assert part.shape == (2, 22, 30)
    assert part.sum() == grids.sum()


# --- the machine from the side


@pytest.mark.parametrize(("boom", "tilt"), [(-0.6, 0.0), (-0.3, 0.4), (0.2, 0.8)])
def test_boom_and_bucket_are_those_of_the_simulator(boom: float, tilt: float) -> None:
    position = 1.3
    x, z = bucket_tip(WA320, jnp.asarray(position), jnp.asarray(boom), jnp.asarray(tilt))
    stance = Stance(float(x), float(z), tilt, boom, 0.0)
    pivot = stance.pivot(WA320)
    # With the boom at its lowest and the bucket level the edge is at the position.
    forward, _ = WA320.tip_arm
    ahead = forward + WA320.boom_length * math.cos(WA320.boom_low)
    np.testing.assert_allclose(pivot, [position - ahead, WA320.pivot_height], atol=1e-5)
    assert np.hypot(*(stance.pin(WA320) - pivot)) == pytest.approx(WA320.boom_length)


def test_on_the_way_back_the_machine_moves_and_the_boom_comes_to_carry() -> None:
    stance = Stance(2.0, 1.2, WA320.tilt_end, -0.1, 1.0)
    back = stance.carried_back(WA320, 6.0)
    np.testing.assert_allclose(
        back.pivot(WA320), stance.pivot(WA320) - np.array([6.0, 0.0]), atol=1e-9
    )
    assert back.boom == pytest.approx(WA320.boom_carry)
    assert back.tilt == stance.tilt
    still = stance.carried_back(WA320, 0.0)
    assert (still.tip_x, still.tip_z) == pytest.approx((stance.tip_x, stance.tip_z))


@pytest.mark.parametrize("tilt", [0.0, 0.4, WA320.tilt_end])
@pytest.mark.parametrize("area", [0.05, 0.5, 1.0])
def test_the_drawn_load_has_its_area_and_lies_in_the_bucket(tilt: float, area: float) -> None:
    inside = bucket_inside(Stance(1.0, 0.5, tilt, 0.0, area), WA320)
    outline = content_outline(inside, area)
    x, z = outline.T
    found = 0.5 * abs(np.dot(x, np.roll(z, 1)) - np.dot(z, np.roll(x, 1)))
    assert found == pytest.approx(area, rel=2e-3)
    assert x.min() >= inside[0, 0] - 1e-9
    assert x.max() <= inside[2, 0] + 1e-9


# --- characteristics


def test_the_drawn_normal_has_the_slope_and_the_incidence_of_the_characteristics() -> None:
    x, y = np.meshgrid(*(CELL_SIZE * np.arange(36.0),) * 2, indexing="ij")
    height = 0.5 * x - 0.3 * y + 0.05 * np.sin(2.0 * x) * np.cos(y)
    normal = mean_normal(height)
    found = characteristics(LocalHeightmap(jnp.asarray(height, jnp.float32), CELL_SIZE, 0.0))
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert math.acos(normal[2]) == pytest.approx(float(found.slope), abs=1e-3)
    into = -normal[:2]
    incidence = abs(math.atan2(into[1], into[0]))
    assert incidence == pytest.approx(float(found.incidence), abs=2e-3)


# --- architectures


def weights_between(stages: list[architectures.Stage]) -> int:
    """Weights and biases of the linear layers between vectors, by the lengths that are drawn."""
    vectors = [stage.shape[0] for stage in stages if len(stage.shape) == 1]
    joined = next(k for k, stage in enumerate(stages) if stage.how == "join")
    skipped = sum(len(stage.shape) == 1 for stage in stages[:joined])
    chain = vectors[skipped:]
    return sum((n + 1) * m for n, m in itertools.pairwise(chain))


def test_the_drawn_lengths_are_those_of_the_weights() -> None:
    rngs = nnx.Rngs(0)
    low = PsiLow((16, 8), scattered=True, rngs=rngs)
    stages = architectures.stages(low)
    assert [stage.shape for stage in stages] == [(4,), (8,), (16,), (8,), (6,)]
    assert architectures.parameters(low) == weights_between(stages)
    high = PsiHigh((16,), encoder="principal", rngs=rngs)
    assert architectures.parameters(high) == weights_between(architectures.stages(high))
    phi = HeightChange((16, 8), rngs=rngs)
    assert architectures.parameters(phi) == weights_between(architectures.stages(phi))


def test_the_paper_s_convolutions_and_autoencoder_are_drawn_with_their_maps() -> None:
    rngs = nnx.Rngs(0)
    high = architectures.stages(PsiHigh((16,), encoder="convolutional", rngs=rngs))
    # Paper, section 4.4: 32 x 32 cells, ten filters, three poolings, a code of 32.
    shapes = [stage.shape for stage in high]
    assert shapes[:6] == [(1, 36), (1, 32), (10, 16), (10, 8), (10, 4), (32,)]
    assert shapes[6:] == [(36,), (16,), (3,)]
    vae = architectures.stages(PhiVae((16,), rngs=rngs))
    shapes = [stage.shape for stage in vae]
    # Section 4.5: 52 cells, 64 inside, a code of 64 that goes on with the action and a range.
    assert shapes[:2] == [(1, 52), (1, 64)]
    assert shapes[-2:] == [(1, 64), (1, 52)]
    at = shapes.index((64,))
    assert shapes[at + 1] == (69,)
    down, up = shapes[1:at], shapes[at + 4 : -1]
    assert down[::-1] == up
