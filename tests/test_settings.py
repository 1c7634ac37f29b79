"""Laws of the settings of trainings: complete, checked, and the one source of the options."""

import dataclasses
import json
import subprocess
import sys
from typing import Any

import click
import pytest

from wlplan.cli.options import training_options
from wlplan.errors import InputError
from wlplan.training import KINDS, PhiVaeSettings, PsiHighSettings, PsiLowSettings
from wlplan.training.settings import Setting, setting_of


@pytest.mark.parametrize("kind", KINDS)
def test_every_setting_has_a_meaning_and_a_default_that_it_allows(kind: str) -> None:
    settings = KINDS[kind]()
    assert settings.kind == kind
    for field in dataclasses.fields(settings):
        setting = setting_of(field)
        assert setting.help
        assert setting.complaint(field.default, field.default) is None
    assert list(settings.as_dict()) == [field.name for field in dataclasses.fields(settings)]
    assert json.loads(json.dumps(settings.as_dict())) == settings.as_dict()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"epochs": 0}, "at least 1"),
        ({"seed": -1}, "at least 0"),
        ({"hidden": (32, 0)}, "at least 1"),
        ({"hidden": ()}, "1 to 8"),
        ({"dropout": 1.0}, "less than 1"),
        ({"learning_rate": 0.0}, "more than 0"),
        ({"learning_rate": float("nan")}, "more than 0"),
        ({"members": 101}, "at most 100"),
        ({"activation": "tanh"}, "swish, leaky_relu"),
        ({"loss": "cubed"}, "huber, squared"),
        ({"encoder": "magic"}, "convolutional, principal"),
        ({"optimiser": "sgd"}, "adamw, adam"),
        ({"patience": -1}, "at least 0"),
        ({"split": "pile"}, "rollout, cycle"),
        ({"scaling": "none"}, "spread, min-max"),
        ({"samples": -1}, "at least 0"),
        ({"mirrored": 1.5}, "at most 1"),
    ],
)
def test_what_a_setting_may_not_be_is_refused_in_one_line(
    change: dict[str, Any], word: str
) -> None:
    with pytest.raises(InputError, match=word) as error:
        PsiHighSettings(**change)
    assert next(iter(change)) in str(error.value)
    assert "\n" not in str(error.value)


def test_components_have_no_range_to_scale_to() -> None:
    with pytest.raises(InputError, match="encoder has to be convolutional"):
        PsiHighSettings(scaling="min-max")
    PsiHighSettings(scaling="min-max", encoder="convolutional")


@pytest.mark.parametrize(("value", "default"), [(1.5, 1), ("1", 1), (True, 1), (True, 1.0)])
def test_a_setting_of_another_type_is_refused(value: object, default: object) -> None:
    assert "has to be a" in (Setting("Number.").complaint(value, default) or "")


def test_every_setting_is_an_option_with_the_defaults_of_the_kinds() -> None:
    @click.command()
    def command(**_: object) -> None:
        """A command."""

    for option in training_options():
        command = option(command)
    assert isinstance(command, click.Command)
    options = {option.name: option for option in command.params}
    told = {
        name: option.help or ""
        for name, option in options.items()
        if isinstance(option, click.Option)
    }
    names = {field.name for kind in KINDS.values() for field in dataclasses.fields(kind)}
    assert set(options) == names - {"seed"}
    assert all(option.default is None for option in options.values())
    assert "psi-low, psi-high 150; phi 100; phi-vae 40; stall 30." in told["epochs"]
    assert told["members"].startswith("psi-low, psi-high: ")
    assert told["hidden"].endswith("phi 512,512; phi-vae 1024,1024; stall 128,128,128.")


def test_settings_of_two_kinds_are_never_the_same() -> None:
    assert PsiLowSettings(dropout=0.1) != PsiHighSettings()  # type: ignore[comparison-overlap]
    assert PhiVaeSettings() == PhiVaeSettings(seed=0)


def test_the_help_of_train_needs_no_jax() -> None:
    code = (
        "import sys; from wlplan import cli; cli.main(['train', '--help']); "
        "sys.exit(str(sorted({'jax', 'flax', 'optax'} & set(sys.modules))))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.stderr.strip() == "[]"
    assert "--learning-rate" in result.stdout
