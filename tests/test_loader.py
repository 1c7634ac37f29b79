"""The machine: linkage, cylinder forces by virtual work, drive, retreat, controller."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.constants import GRAVITY
from wlplan.engines.limits import SMOOTHING_TIME
from wlplan.engines.simulator import controller, loader
from wlplan.site.machine import WA320
from wlplan.types import Action


def scalars(*values: float) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(v, jnp.result_type(float)) for v in values)


def tip(position: float, boom: float, tilt: float) -> np.ndarray:
    return np.asarray(loader.bucket_tip(WA320, *scalars(position, boom, tilt)))


def test_the_lowered_level_bucket_has_its_edge_at_position_and_on_the_ground() -> None:
    for position in (-5.0, 0.0, 2.3):
        np.testing.assert_allclose(tip(position, WA320.boom_low, 0.0), [position, 0.0], atol=1e-6)


def test_the_drive_carries_the_bucket_along() -> None:
    np.testing.assert_allclose(tip(1.5, 0.2, 0.4) - tip(0.0, 0.2, 0.4), [1.5, 0.0], atol=1e-6)


def test_the_parallel_linkage_keeps_the_tilt() -> None:
    """The boom moves the edge along the same arc of its own radius, whatever the tilt."""
    booms = np.linspace(WA320.boom_low, WA320.boom_high, 7)
    for tilt in (0.0, 0.5):
        path = np.stack([tip(0.0, b, tilt) for b in booms])
        arm = WA320.boom_length * np.stack([np.cos(booms), np.sin(booms)], axis=1)
        np.testing.assert_allclose(path - path[0], arm - arm[0], atol=1e-5)


def test_the_tilt_moves_the_edge_on_a_circle_about_the_pin() -> None:
    forward, down = WA320.tip_arm
    assert math.hypot(forward, down) == pytest.approx(WA320.tip_radius)
    # The pin of a level bucket is behind and above its edge.
    pin = tip(0.0, -0.3, 0.0) + np.array([-forward, down])
    start = tip(0.0, -0.3, 0.0) - pin
    for tilt in np.linspace(0.0, WA320.tilt_end, 5):
        arm = tip(0.0, -0.3, tilt) - pin
        assert np.hypot(*arm) == pytest.approx(WA320.tip_radius, rel=1e-5)
        turned = math.atan2(arm[1], arm[0]) - math.atan2(start[1], start[0])
        assert turned == pytest.approx(tilt, abs=1e-5)


@pytest.mark.parametrize(("vertical", "horizontal"), [(0.0, 0.0), (30e3, 0.0), (12e3, 80e3)])
def test_boom_force_is_the_virtual_work_of_a_small_lift(vertical: float, horizontal: float) -> None:
    """What the cylinders do over a small lift is what weights gain and the soil takes."""
    with jax.enable_x64(True):

        def potential(boom: float) -> float:
            x, z = loader.bucket_tip(WA320, *scalars(0.0, boom, 0.3))
            # The boom's own centre of mass lies halfway to the pin.
            lifted = (WA320.bucket_mass + 0.5 * WA320.boom_mass) * GRAVITY + vertical
            return float(lifted * z + horizontal * x)

        for boom in (-0.6, -0.2, 0.3):
            by_work = (potential(boom + 1e-5) - potential(boom - 1e-5)) / 2e-5 / WA320.boom_lever
            force = loader.boom_force(WA320, *scalars(boom, vertical, horizontal))
            assert force == pytest.approx(by_work, rel=1e-7)


def test_a_lowered_boom_feels_the_horizontal_force() -> None:
    """This is what triggers the controller; a boom above the horizontal is relieved by it."""
    rest, pushed = (loader.boom_force(WA320, *scalars(WA320.boom_low, 0.0, h)) for h in (0.0, 50e3))
    assert pushed > rest > 0.0
    rest, pushed = (loader.boom_force(WA320, *scalars(0.3, 0.0, h)) for h in (0.0, 50e3))
    assert pushed < rest


@pytest.mark.parametrize(
    ("vertical", "horizontal", "moment"), [(0, 0, 0), (39e3, 60e3, 0), (39e3, 60e3, -12e3)]
)
def test_tilt_moment_is_the_virtual_work_of_a_small_tilt(
    vertical: float, horizontal: float, moment: float
) -> None:
    with jax.enable_x64(True):

        def potential(tilt: float) -> float:
            x, z = loader.bucket_tip(WA320, *scalars(0.0, -0.4, tilt))
            middle = z - 0.5 * WA320.bucket_depth * math.sin(tilt)
            own = WA320.bucket_mass * GRAVITY * middle
            return float(own + vertical * z + horizontal * x + moment * tilt)

        for tilt in (0.0, 0.4, 0.8):
            by_work = (potential(tilt + 1e-5) - potential(tilt - 1e-5)) / 2e-5
            required = loader.tilt_moment(WA320, *scalars(tilt, vertical, horizontal, moment))
            assert required == pytest.approx(by_work, rel=1e-7)


def test_an_actuator_slows_down_and_stalls() -> None:
    speed = [float(loader.actuator_speed(scalars(x)[0], 100.0)) for x in (-50, 0, 90, 95, 100, 150)]
    np.testing.assert_allclose(speed, [1, 1, 1, 0.5, 0, 0], atol=1e-6)


def test_drive_respects_traction_power_and_the_travel_speed() -> None:
    speeds = np.linspace(0.0, WA320.travel_speed, 50)
    for vertical in (0.0, 40e3):
        traction = WA320.traction * (WA320.mass * GRAVITY + vertical)
        for speed in speeds:
            thrust, slip = map(float, loader.drive(WA320, *scalars(speed, vertical)))
            assert 0.0 <= thrust <= traction * (1 + 1e-6)
            assert thrust * speed <= WA320.wheel_power * (1 + 1e-6)
            assert 0.0 <= slip <= WA320.slip_speed
            assert thrust * (speed + slip) <= WA320.wheel_power * (1 + 1e-5)
            if thrust < 0.9 * traction:
                assert slip == 0.0
    thrust, slip = map(float, loader.drive(WA320, *scalars(WA320.travel_speed, 0.0)))
    assert thrust == 0.0
    assert slip == 0.0
    # At standstill traction is the limit, and the wheels slip as far as is allowed.
    thrust, slip = map(float, loader.drive(WA320, *scalars(0.0, 0.0)))
    assert thrust == pytest.approx(WA320.traction * WA320.mass * GRAVITY)
    assert slip == pytest.approx(WA320.slip_speed)


def test_a_pressed_down_front_axle_pushes_harder() -> None:
    light, heavy = (loader.drive(WA320, *scalars(0.1, v))[0] for v in (0.0, 30e3))
    assert heavy - light == pytest.approx(WA320.traction * 30e3, rel=1e-4)


def retreat(position: float, boom: float, mass: float) -> list[float]:
    return [float(v) for v in loader.retreat(WA320, *scalars(position, boom, mass))]


def test_retreat_with_the_boom_up_is_a_drive_at_travel_speed() -> None:
    """Time and work of constant power up to travel speed, integrated here."""
    position, mass = 2.0, 3000.0
    time, drive, boom = retreat(position, WA320.boom_carry, mass)
    total = WA320.mass + mass
    step, speed, x, elapsed = 1e-4, 0.0, 0.0, 0.0
    while x < WA320.approach_distance + position:
        # Constant power into kinetic energy.
        speed = min(math.sqrt(speed**2 + 2 * WA320.wheel_power / total * step), WA320.travel_speed)
        x, elapsed = x + speed * step, elapsed + step
    assert time == pytest.approx(elapsed, rel=1e-3)
    rolling = WA320.rolling_resistance * total * GRAVITY * (WA320.approach_distance + position)
    assert drive == pytest.approx(0.5 * total * WA320.travel_speed**2 + rolling, rel=1e-5)
    assert boom == 0.0


def test_retreat_with_the_boom_down_may_wait_for_the_lift() -> None:
    mass = 3000.0
    time, _, boom = retreat(-4.9, WA320.boom_low, mass)
    angle = WA320.boom_carry - WA320.boom_low
    assert time == pytest.approx(angle / (0.6 * WA320.boom_speed), rel=1e-5)
    lift = WA320.boom_length * (math.sin(WA320.boom_carry) - math.sin(WA320.boom_low))
    raised = WA320.bucket_mass + 0.5 * WA320.boom_mass + mass
    assert boom == pytest.approx(raised * GRAVITY * lift, rel=1e-5)
    # A boom above the carry angle is lowered: that takes time and no work.
    assert retreat(0.0, 0.3, mass)[2] == 0.0


def test_the_controller_clips_to_full_speed() -> None:
    action = Action(*scalars(0.2, 4.0, 0.5, 1.0))
    for force, boom, bucket in ((0.1, 0, 0), (0.3, 0.4, 0), (0.6, 1, 0.1), (2.0, 1, 1)):
        out = controller.command(action, *scalars(force))
        np.testing.assert_allclose(out, [boom, bucket], atol=1e-6)


@pytest.mark.parametrize("step", [0.001, 0.005, 0.02])
def test_smoothing_reaches_its_target_with_its_time_constant(step: float) -> None:
    value, target = scalars(0.0, 1.0)
    missing = []
    for _ in range(round(1.0 / step)):
        missing.append(1.0 - float(value))
        value = controller.smooth(value, target, step)
    # The area above the curve is the mean delay, whatever the step.
    assert sum(missing) * step == pytest.approx(SMOOTHING_TIME + step, rel=2e-2)
    assert value == pytest.approx(1.0, abs=1e-4)
    assert np.all(np.diff(missing) <= 0.0)
    assert controller.smooth(target, target, step) == 1.0
