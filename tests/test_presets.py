"""Soils and machines by name and from files: what they give, and how every nonsense is refused."""

import dataclasses
import functools
import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import wlplan
from wlplan.constants import CELL_SIZE
from wlplan.engines.simulator.cycle import Settings, dig
from wlplan.errors import InputError
from wlplan.site import parameters, presets
from wlplan.site.machine import MACHINES, WA320, WheelLoader
from wlplan.site.parameters import ranges_of
from wlplan.site.presets import (
    check_machine,
    check_soil,
    machine_named,
    machine_recorded,
    soil_named,
    soil_recorded,
)
from wlplan.site.soil import CLAY, GRAVEL, SAND, SOILS, Soil
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT
from wlplan.types import Action

FITTED = (
    *("fill_factor", "edge_resistance", "content_push", "content_carry"),
    *("intrusion_stiffness", "slide_rate"),
)
SOIL_FIELDS = [field.name for field in dataclasses.fields(Soil)]
MACHINE_FIELDS = [field.name for field in dataclasses.fields(WheelLoader)]
ANGLES = ("friction", "steel_friction")
MACHINE_ANGLES = ("boom_low", "boom_carry", "boom_high", "tilt_end", "boom_speed", "tilt_speed")


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a TOML file and return its path."""

    def write_text(text: str, name: str = "given.toml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write_text


def refused(make: Callable[[], object], *words: str) -> str:
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    for word in words:
        assert word in message
    return message


# --- presets


@pytest.mark.parametrize("name", SOILS)
def test_every_preset_soil_makes_sense(name: str) -> None:
    soil = soil_named(name)
    check_soil(soil)
    assert soil == SOILS[name]
    assert hash(soil) == hash(dataclasses.replace(soil))
    # Nothing was fitted for the others.
    assert all(getattr(soil, field) == getattr(GRAVEL, field) for field in FITTED)
    assert soil.repose_angle == soil.friction


@pytest.mark.parametrize("name", MACHINES)
def test_every_preset_machine_makes_sense(name: str) -> None:
    check_machine(machine_named(name))


def test_the_presets_that_are_asked_for() -> None:
    assert {"gravel", "sand", "wet-sand", "dirt", "clay"} <= set(SOILS)
    assert wlplan.soil_named("gravel") is GRAVEL
    assert wlplan.machine_named("wa320") is WA320
    assert SOILS["wet-sand"].density > SOILS["sand"].density
    assert CLAY.cohesion > SOILS["dirt"].cohesion > SAND.cohesion == 0.0


def test_every_field_has_its_range_and_the_map_its_size() -> None:
    assert list(ranges_of(Soil)) == SOIL_FIELDS
    assert list(ranges_of(WheelLoader)) == MACHINE_FIELDS
    assert pytest.approx(STATE_CELLS * CELL_SIZE) == parameters.MAP_WIDTH
    assert parameters.MAP_BEHIND == STATE_DISPLACEMENT
    assert Settings().step == presets._LONGEST_STEP
    for ranges, angles in (
        (ranges_of(Soil), ANGLES),
        (ranges_of(WheelLoader), MACHINE_ANGLES),
    ):
        assert [name for name, allowed in ranges.items() if allowed.is_angular] == list(angles)


# --- files


def toml(values: Soil | WheelLoader, angles: Collection[str]) -> str:
    """All values of a soil or machine as a TOML file."""
    lines = []
    for name, value in dataclasses.asdict(values).items():
        angular = name in angles
        lines.append(
            f"{name}{'_deg' if angular else ''} = {math.degrees(value)!r}"
            if angular
            else f"{name} = {value!r}"
        )
    return "\n".join(lines)


@pytest.mark.parametrize("name", SOILS)
def test_a_soil_goes_through_a_file(write: Callable[..., Path], name: str) -> None:
    found = soil_named(write(toml(SOILS[name], ANGLES)))
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(SOILS[name]), rel=1e-12)


def test_a_machine_goes_through_a_file(write: Callable[..., Path]) -> None:
    larger = dataclasses.replace(WA320, bucket_width=2.9, tilt_speed=math.radians(40.0))
    found = machine_named(str(write(toml(larger, MACHINE_ANGLES))))
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(larger), rel=1e-12)


def test_a_file_may_start_from_a_preset(write: Callable[..., Path]) -> None:
    found = soil_named(write('preset = "clay"\ndensity = 1700\nfriction_deg = 22\n'))
    assert found == dataclasses.replace(CLAY, density=1700.0, friction=math.radians(22.0))
    assert isinstance(found.density, float)
    assert soil_named(write("")) == GRAVEL
    assert machine_named(write("tilt_speed_deg = 30.0")) == dataclasses.replace(
        WA320, tilt_speed=math.radians(30.0)
    )


def test_a_preset_goes_before_a_file_of_its_name(
    write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("density = 1600", "sand")
    monkeypatch.chdir(tmp_path)
    assert soil_named("sand") == SAND
    assert soil_named("./sand") == dataclasses.replace(GRAVEL, density=1600.0)


def test_a_soil_may_rest_at_another_angle(write: Callable[..., Path]) -> None:
    steep = soil_named("sand@45")
    assert steep.repose_angle == pytest.approx(math.radians(45.0))
    assert dataclasses.replace(steep, friction=SAND.friction) == SAND
    own = write("density = 1500.0")
    assert soil_named(f"{own}@40") == dataclasses.replace(
        soil_named(own), friction=math.radians(40.0)
    )
    for name, word in (("sand@", "no angle"), ("sand@x", "no angle"), ("sand@80", "5 to 60")):
        with pytest.raises(InputError, match=word):
            soil_named(name)


def test_the_ends_of_a_range_count_as_inside(write: Callable[..., Path]) -> None:
    assert math.degrees(soil_named(write("friction_deg = 60")).friction) == pytest.approx(60.0)
    assert machine_named(write("bucket_width = 4.6")).bucket_width == 4.6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("density = -1600", ["density is -1600", "200 to 5000 kg/m³"]),
        ("density = nan", ["density", "finite"]),
        ("density = inf", ["density", "finite"]),
        ("density = true", ["density is True", "number"]),
        ('density = "heavy"', ["density is 'heavy'", "number"]),
        ("density = [1600]", ["density", "number"]),
        ("density = 2020-01-01", ["density", "number"]),
        ("density = 1" + 400 * "0", ["density", "finite"]),
        ("density = 1" + 5000 * "0", ["TOML"]),
        ("[density]\nbulk = 1600", ["density", "number"]),
        ("friction_deg = 95", ["friction_deg is 95°", "5 to 60°"]),
        ("friction_deg = 0", ["friction_deg is 0°"]),
        ("friction = 0.5", ["friction is an angle", "friction_deg", "degrees"]),
        ("cohesion = -1", ["cohesion is -1 Pa"]),
        ("steel_friction_deg = 40", ["steel_friction_deg is 40°", "friction_deg, 32°"]),
        ("adhesion = 10", ["adhesion is 10 Pa", "cohesion, 0 Pa"]),
        ("content_push = -1", ["content_push"]),
        ("densty = 1600", ["densty", "density"]),
        ("density_deg = 1600", ["density_deg", "density"]),
        ("frction = 30", ["frction", "friction_deg"]),
        ('"den\\nsity" = 1600', ["density"]),
        ('preset = "sandd"', ["preset is 'sandd'", "wet-sand"]),
        ("preset = 3", ["preset is 3"]),
        ("density 1600", ["TOML", "line 1"]),
        ("density = 1\ndensity = 2", ["TOML"]),
        ("a = " + 3000 * "[", ["TOML"]),
        (60_000 * "# ", ["too large"]),
    ],
)
def test_nonsense_in_a_soil_file_is_refused_by_name(
    write: Callable[..., Path], text: str, words: list[str]
) -> None:
    refused(lambda: soil_named(write(text)), "given.toml", *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bucket_width = 4.7", ["bucket_width is 4.7 m", "0.5 to 4.6 m"]),
        ("bucket_width = false", ["bucket_width is False"]),
        ("mass = -15000", ["mass is -15000 kg"]),
        ("travel_speed = 8.0", ["travel_speed is 8 m/s", "1 to 5 m/s"]),
        ("tilt_speed = 0.6", ["tilt_speed_deg", "degrees a second"]),
        ("boom_speed_deg = 0", ["boom_speed_deg is 0°/s"]),
        ("boom_carry_deg = -50", ["boom_low_deg is -37°", "boom_carry_deg, -50°"]),
        ("bucket_mass = 20000", ["bucket_mass is 20000 kg", "mass, 15200 kg"]),
        ("pivot_height = 4.0", ["tip_radius is 1.25 m", "boom_low_deg", "pivot_height"]),
        ("boom_low_deg = -60", ["tip_radius", "boom_low_deg"]),
        ("speed_gain = 5e6", ["speed_gain is 5e+06", "760000 N s/m"]),
        ("bucket_widht = 2.0", ["bucket_widht", "bucket_width"]),
        ('preset = "gravel"', ["preset is 'gravel'", "wa320"]),
    ],
)
def test_nonsense_in_a_machine_file_is_refused_by_name(
    write: Callable[..., Path], text: str, words: list[str]
) -> None:
    refused(lambda: machine_named(write(text)), "given.toml", *words)


def test_a_name_that_is_none_is_refused(tmp_path: Path) -> None:
    refused(lambda: soil_named("sandd"), "'sandd'", "did you mean sand", "clay")
    refused(lambda: soil_named(""), "no such soil")
    refused(lambda: soil_named("a\0b"), "no such soil")
    refused(lambda: soil_named(tmp_path), "is a folder")
    refused(lambda: machine_named("wa230"), "wa320")
    refused(lambda: machine_named(tmp_path / "none.toml"), "no such machine")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    refused(lambda: machine_named(tmp_path / "binary.toml"), "binary.toml", "TOML")


@pytest.mark.parametrize("value", [math.nan, -math.inf, -1e9, 1e9])
@pytest.mark.parametrize(("check", "preset"), [(check_soil, GRAVEL), (check_machine, WA320)])
def test_every_field_refuses_nonsense_by_its_name(
    check: Callable[[Any], None], preset: Soil | WheelLoader, value: float
) -> None:
    for field in dataclasses.fields(preset):
        change: dict[str, Any] = {field.name: value}
        wrong = dataclasses.replace(preset, **change)
        assert refused(functools.partial(check, wrong)).startswith(f"{field.name} is ")


def test_a_world_refuses_what_makes_no_sense() -> None:
    with pytest.raises(InputError, match="density is -1"):
        wlplan.load_world("simulator", soil=dataclasses.replace(GRAVEL, density=-1.0))
    with pytest.raises(InputError, match="bucket_width is 9 m"):
        wlplan.load_world("low", machine=dataclasses.replace(WA320, bucket_width=9.0))


@pytest.mark.parametrize("name", ["simulator", "low"])
def test_a_world_has_the_soil_and_machine_it_is_given(name: str) -> None:
    narrow = dataclasses.replace(WA320, bucket_width=1.8)
    world: Any = wlplan.load_world(name, soil=SAND, machine=narrow)
    assert (world.soil, world.machine) == (SAND, narrow)
    world = wlplan.load_world(name)
    assert (world.soil, world.machine) == (GRAVEL, WA320)


# --- records


def test_a_record_gives_back_what_was_recorded() -> None:
    for soil in SOILS.values():
        assert soil_recorded(dataclasses.asdict(soil)) == soil
    assert machine_recorded(dataclasses.asdict(WA320)) == WA320
    assert soil_recorded({"density": 1600}) == dataclasses.replace(GRAVEL, density=1600.0)


def test_a_record_that_makes_no_sense_is_refused() -> None:
    refused(lambda: soil_recorded(None), "soil")
    refused(lambda: soil_recorded({"density": "1"}), "density")
    refused(lambda: soil_recorded({"friction": 2.0}), "friction is 114.592°")
    refused(lambda: machine_recorded({"bucket_widht": 2.0}), "bucket_width")


# --- what they do in a cycle


@pytest.fixture(scope="module")
def loaded() -> Callable[..., float]:
    """Load [kg] of one cycle on a slope of 28 degrees.

    The action goes in as far as it may: one that lifts by force would go deeper with a narrow
    bucket, which meets less, and load more.
    """
    along = jnp.arange(STATE_CELLS) * CELL_SIZE - STATE_DISPLACEMENT
    slope = jnp.clip(along * math.tan(math.radians(28.0)), 0.0, 2.0)
    height = jnp.broadcast_to(slope[:, None], (STATE_CELLS, STATE_CELLS))
    action = Action(0.2, 1.0, 0.6, 1.5)

    @functools.cache
    def load(soil: Soil = GRAVEL, machine: WheelLoader = WA320) -> float:
        def play(height: jax.Array) -> jax.Array:
            return dig(height, jnp.zeros_like(height), action, machine=machine, soil=soil).mass

        return float(jax.jit(play)(height))

    return load


def test_denser_soil_means_more_mass(loaded: Callable[..., float]) -> None:
    heavy = dataclasses.replace(GRAVEL, density=1.2 * GRAVEL.density)
    assert loaded(soil=heavy) > loaded() > 0.0


def test_a_narrower_bucket_loads_less(loaded: Callable[..., float]) -> None:
    narrow = dataclasses.replace(WA320, bucket_width=1.8, bucket_heaped=3.0 * 1.8 / 2.7)
    assert 0.0 < loaded(machine=narrow) < 0.9 * loaded()


@pytest.mark.slow
def test_the_widest_bucket_that_is_let_pass_digs(loaded: Callable[..., float]) -> None:
    widest = dataclasses.replace(WA320, bucket_width=ranges_of(WheelLoader)["bucket_width"].high)
    assert 0.0 < loaded(machine=widest) < 2.0 * loaded()


def test_sticky_soil_digs(loaded: Callable[..., float]) -> None:
    assert 0.0 < loaded(soil=CLAY) < 1.5 * loaded()
