"""plan.json: plans on disk."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError, one_line
from wlplan.io.documents import parse_json
from wlplan.io.files import check_is_file, named, write_text_atomic
from wlplan.types import Action, LoadingPlan, Performance, Pose
from wlplan.xla import floats

PLAN_FORMAT = "wlplan.plan/1"

# Slack on the box of the actions, for numbers that went through float32.
_ROUNDING = 1e-6


def plan_to_dict(
    plan: LoadingPlan,
    *,
    predicted: Performance | None = None,
    simulated: Performance | None = None,
    deviation: Performance | None = None,
    stall_probability: Sequence[float] | None = None,
    transport: Mapping[str, Any] | None = None,
    paths: Sequence[Mapping[str, Any]] | None = None,
    **rest: Any,
) -> dict[str, Any]:
    """Lay a plan out as the content of a plan.json.

    Args:
        plan: The loadings, leaves [N].
        predicted: Performance by the world that planned, leaves [N], tonne, s, kJ.
        simulated: Performance in the simulator, likewise.
        deviation: Standard deviation of the error of what is predicted, by the same, likewise.
        stall_probability: How likely each load stalls by the world that planned [1].
        transport: Arrays [N] by name, "time" [s] and "work" [kJ], of driving to the truck and back.
        paths: What else is said of each load: its path and its clearance.
        **rest: Further top-level fields: pile, world, objective, seed, total, ledger.
    """
    pose, action = _columns(plan.pose), _columns(plan.action)
    extra = {
        "predicted": predicted and _columns(predicted),
        "deviation": deviation and _columns(deviation),
        "transport": transport and {name: np.asarray(v).tolist() for name, v in transport.items()},
        "simulated": simulated and _columns(simulated),
    }
    loads = []
    for n in range(len(pose["x"])):
        load: dict[str, Any] = {name: values[n] for name, values in pose.items()}
        load["action"] = {name: values[n] for name, values in action.items()}
        for part, columns in extra.items():
            if columns:
                load[part] = {name: values[n] for name, values in columns.items()}
        if stall_probability is not None:
            load["stall_probability"] = float(stall_probability[n])
        load |= {} if paths is None else paths[n]
        loads.append(load)
    return {"format": PLAN_FORMAT, **rest, "loads": loads}


def _columns(record: Any) -> dict[str, list[float]]:
    return {
        field.name: np.asarray(getattr(record, field.name), np.float64).tolist()
        for field in dataclasses.fields(record)
    }


def write_plan(path: str | os.PathLike[str], document: Mapping[str, Any]) -> None:
    """Write the content of a plan.json, in one piece or not at all.

    Args:
        path: File to write.
        document: Content as of `plan_to_dict`; numpy and JAX numbers are taken too.

    Raises:
        InputError: If `read_plan` would refuse it, or the file cannot be written.
    """
    with named(Path(path)):
        text = json.dumps(
            dict(document), indent=2, default=lambda value: np.asarray(value).tolist()
        )
        _parse_plan(text)
    write_text_atomic(path, text + "\n")


def read_plan(path: str | os.PathLike[str]) -> tuple[LoadingPlan, dict[str, Any]]:
    """Read a plan.json.

    Returns:
        The plan, leaves [N], and the whole document.

    Raises:
        InputError: If it is not a plan that can be played; one line that says where and why.
    """
    path = Path(path)
    check_is_file(path, "plan")
    with named(path):
        try:
            text = path.read_bytes().decode()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot be read ({one_line(error)}): is it a plan.json?") from error
        return _parse_plan(text)


def _parse_plan(text: str) -> tuple[LoadingPlan, dict[str, Any]]:
    document = parse_json(text)
    found = document.get("format") if isinstance(document, dict) else None
    if found != PLAN_FORMAT:
        raise InputError(
            f"has format {one_line(repr(found))}, not {PLAN_FORMAT!r}: it is not a plan, or one "
            f"for another version of wlplan."
        )
    loads = document.get("loads")
    if not isinstance(loads, list) or not loads:
        raise InputError("has no loads: `loads` has to be a list with at least one loading.")
    pose_names = [field.name for field in dataclasses.fields(Pose)]
    action_names = [field.name for field in dataclasses.fields(Action)]
    poses, actions = [], []
    for n, load in enumerate(loads, start=1):
        poses.append([_number(load, name, f"load {n}") for name in pose_names])
        action = _member(load, "action", f"load {n}")
        actions.append([_number(action, name, f"load {n}, action") for name in action_names])
        for name, value, low, high in zip(
            action_names, actions[-1], ACTION_LOW, ACTION_HIGH, strict=True
        ):
            if not low - _ROUNDING <= value <= high + _ROUNDING:
                raise InputError(
                    f"load {n}: {name} is {value:g}, outside its range {low:g} to {high:g}."
                )
    actions_in_box = np.clip(np.array(actions), ACTION_LOW, ACTION_HIGH)
    plan = LoadingPlan(
        pose=Pose(*(floats(column) for column in np.array(poses).T)),
        action=Action(*(floats(column) for column in actions_in_box.T)),
        truck=_trucks_of(document, len(loads)),
    )
    return plan, document


def _trucks_of(document: Mapping[str, Any], count: int) -> Array | None:
    """The truck of each load; None if the plan names no trucks.

    Raises:
        InputError: If some load goes to no truck or to several, or trucks are not filled in turn.
    """
    trucks = document.get("trucks")
    if trucks is None:
        return None
    wrong = InputError("`trucks` does not say in turn which loads, counted from 0, each is given.")
    if not isinstance(trucks, list):
        raise wrong
    given: list[Any] = []
    for truck in trucks:
        loads = _member(truck, "loads", "a truck")
        if not isinstance(loads, list):
            raise wrong
        given.append(loads)
    if [load for loads in given for load in loads] != list(range(count)):
        raise wrong
    return jnp.asarray(np.repeat(np.arange(len(given)), [len(loads) for loads in given]))


def _member(record: Any, name: str, where: str) -> Any:
    if not isinstance(record, dict) or name not in record:
        raise InputError(f"{where}: `{name}` is missing.")
    return record[name]


def _number(record: Any, name: str, where: str) -> float:
    value = _member(record, name, where)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e30:
        raise InputError(f"{where}: `{name}` is {one_line(repr(value))}, not a finite number.")
    return float(value)
