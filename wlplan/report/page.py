"""The report of a plan: one HTML file that needs nothing beside it and opens in any browser."""

from __future__ import annotations

import base64
import html
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wlplan.io import write_text_atomic

REPORT_NAME = "report.html"

_STYLE = """
:root { --ink: #1d2733; --faint: #6b7785; --line: #dfe3e7; --blue: #1f5fa8; --orange: #b85c00; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 2rem 1.5rem 4rem; color: var(--ink);
  background: #fff; font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; margin: 0; } h2 { font-size: 1.2rem; margin: 2.5rem 0 .6rem; }
.sub { color: var(--faint); margin: .2rem 0 1.6rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: 1rem; }
.card { border: 1px solid var(--line); border-radius: .6rem; padding: .9rem 1.1rem; }
.card h3 { margin: 0; font-size: .85rem; font-weight: 600; color: var(--faint); }
.card .big { font-size: 1.7rem; font-weight: 650; line-height: 1.3; }
.card p { margin: .1rem 0 0; font-size: .9rem; }
.p { color: var(--blue); } .s { color: var(--orange); }
figure { margin: 0 0 1.2rem; } figcaption { color: var(--faint); font-size: .9rem; }
img { display: block; width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th { font-weight: 600; color: var(--faint); } td:first-child, th:first-child { text-align: left; }
tr.sum td { font-weight: 650; border-top: 2px solid var(--ink); }
table.facts td { text-align: left; white-space: normal; }
table.facts td:first-child { color: var(--faint); }
.warn { border-left: 4px solid var(--orange); padding: .5rem 1rem; background: #fdf4ec; }
li { margin: .3rem 0; }
@media print { body { max-width: none; padding: 0; } .card, figure, tr { break-inside: avoid; } }
"""

_QUANTITIES = (
    ("mass", "Mass", "t", 2),
    ("time", "Loading time", "s", 1),
    ("work", "Work", "kJ", 0),
)

# Relative error above which a ledger does not count as closed.
LEDGER_TOLERANCE = 1e-4


def write_report(
    folder: str | os.PathLike[str],
    document: Mapping[str, Any],
    *,
    figures: Sequence[tuple[bytes, str]] = (),
    settings: Mapping[str, str] | None = None,
) -> Path:
    """Write `report.html` into a folder, in one piece or not at all.

    Args:
        folder: Existing folder.
        document: Content of a plan.json with its `predicted`, `simulated`, `total` and `ledger`.
        figures: PNG files as bytes, each with its caption.
        settings: Further lines for the table of settings, by name.

    Returns:
        Path of the report.

    Raises:
        InputError: If it cannot be written.
    """
    path = Path(folder) / REPORT_NAME
    write_text_atomic(path, render_report(document, figures=figures, settings=settings))
    return path


def render_report(
    document: Mapping[str, Any],
    *,
    figures: Sequence[tuple[bytes, str]] = (),
    settings: Mapping[str, str] | None = None,
) -> str:
    """The report as HTML; arguments as for `write_report`. Every text is escaped."""
    pile = document.get("pile", {})
    count = len(document["loads"])
    title = (
        f"Loading plan: {count} load{'s' if count != 1 else ''} from {pile.get('file', 'a pile')}"
    )
    parts = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="sub">planned by {_text(document.get("planner", "an unnamed planner"))} in the '
        f"{_text(document.get('world', 'unnamed'))} world for "
        f"{_text(document.get('objective', 'an unnamed objective'))}, then played in the "
        f"simulator</p>",
        _ledger_warning(document.get("ledger", {})),
        _cards(document),
        *(_figure(*figure) for figure in figures),
        "<h2>Loads</h2>",
        _loads_table(document),
        "<h2>Ledger</h2>",
        _ledger(document.get("ledger", {})),
        "<h2>Settings</h2>",
        _settings(document, settings or {}),
        "<h2>How to read this</h2>",
        _GUIDE,
        "<h2>What it does not tell</h2>",
        _NOTES,
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n"
        "</body>\n</html>\n"
    )


_GUIDE = """<ul>
<li><b>Predicted</b> is what the planning world expected, <b>simulated</b> what the same plan gave
in the simulator; the difference is (predicted &minus; simulated) / simulated.</li>
<li>x and y are the dig location at the toe of the pile as it is when the load is taken, in the
frame of the scan: x east, y north, metres. The heading points into the pile, counter-clockwise
from east. Digs of later loads lie further in, because the toe moves back.</li>
<li>Time and work of a load run from the start of the approach, 5 m before the dig location, to the
stop 5 m behind it. Driving to the truck, dumping and the way back are the transport.</li>
<li>The cost is what the planner makes small: the weighted sum over the loads of time and work,
transport included, and of the inverse of the mass, each relative to a typical load.</li>
<li>&delta; are the force thresholds and k the velocity gains of the bucket-filling controller,
for the boom (bm) and the bucket (bk).</li>
</ul>"""

_NOTES = """<ul>
<li>The models were trained on, and the plan was checked in, this package's own simulator of a wheel
loader; it was fitted to dry gravel and a loader of the WA320 class, whatever the soil and the
machine under Settings are. It is not a measurement on a machine.</li>
<li>The transport is an estimate from the length of a V-turn at constant speed. Obstacles, the
pile among them, are not looked at: check that the way to the truck is free.</li>
<li>Cells that the scan did not see, hatched in the maps, are filled in from their surroundings: a
load that reaches into them rests on a guess.</li>
</ul>"""


def _text(value: object) -> str:
    return html.escape(str(value))


def _plain(value: object) -> str:
    """A value of plan.json, lists without brackets and numbers without noise."""
    if isinstance(value, list | tuple):
        return ", ".join(_plain(part) for part in value)
    return _text(f"{value:.6g}" if isinstance(value, float) else value)


def _number(value: object, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "&ndash;"
    return f"{value:,.{digits}f}".replace("-", "&minus;")


def _difference(predicted: object, simulated: object) -> str:
    numbers = isinstance(predicted, int | float) and isinstance(simulated, int | float)
    if not numbers or not simulated:
        return "&ndash;"
    return f"{100.0 * (predicted / simulated - 1.0):+.1f}&nbsp;%".replace(  # type: ignore[operator]
        "-", "&minus;"
    )


def _cards(document: Mapping[str, Any]) -> str:
    total = document.get("total", {})
    predicted, simulated = total.get("predicted", {}), total.get("simulated", {})
    transport = total.get("transport", {})
    cards = []
    for name, title, unit, digits in (*_QUANTITIES, ("cost", "Cost", "", 2)):
        p, s = predicted.get(name), simulated.get(name)
        lines = [
            f"<h3>{title}</h3>",
            f'<div class="big s">{_number(s, digits)} {unit}</div>',
            "<p>simulated</p>",
            f'<p><span class="p">{_number(p, digits)} {unit}</span> predicted, '
            f"{_difference(p, s)}</p>",
        ]
        if name in transport:
            lines.append(f"<p>and {_number(transport[name], digits)} {unit} of transport</p>")
        cards.append(f'<div class="card">{"".join(lines)}</div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _figure(png: bytes, caption: str) -> str:
    data = base64.b64encode(png).decode("ascii")
    return (
        f"<h2>{_text(caption)}</h2>\n"
        f'<figure><img alt="{_text(caption)}" src="data:image/png;base64,{data}"></figure>'
    )


def _loads_table(document: Mapping[str, Any]) -> str:
    head = "<th>load</th><th>x [m]</th><th>y [m]</th><th>heading [°]</th>"
    head += "<th>δ<sub>bm</sub></th><th>k<sub>bm</sub></th><th>δ<sub>bk</sub></th>"
    head += "<th>k<sub>bk</sub></th>"
    for _, title, unit, _ in _QUANTITIES:
        head += f"<th>{title} [{unit}]</th><th>simulated</th>"
    head += "<th>Transport [s]</th><th>[kJ]</th>"
    rows = []
    for n, load in enumerate(document["loads"], start=1):
        cells = [str(n), _number(load["x"]), _number(load["y"])]
        cells.append(_number(round(math.degrees(load["heading"])), 0))
        cells += [_number(value) for value in load["action"].values()]
        cells += _pairs(load.get("predicted", {}), load.get("simulated", {}))
        transport = load.get("transport", {})
        cells += [_number(transport.get("time"), 1), _number(transport.get("work"), 0)]
        rows.append(_row(cells))
    total = document.get("total", {})
    cells = ["sum"] + [""] * 7
    cells += _pairs(total.get("predicted", {}), total.get("simulated", {}))
    transport = total.get("transport", {})
    cells += [_number(transport.get("time"), 1), _number(transport.get("work"), 0)]
    rows.append(_row(cells, "sum"))
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _pairs(predicted: Mapping[str, Any], simulated: Mapping[str, Any]) -> list[str]:
    cells = []
    for name, _, _, digits in _QUANTITIES:
        cells.append(f'<span class="p">{_number(predicted.get(name), digits)}</span>')
        cells.append(f'<span class="s">{_number(simulated.get(name), digits)}</span>')
    return cells


def _row(cells: Sequence[str], kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f"<tr{mark}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _ledger(ledger: Mapping[str, Any]) -> str:
    before, after = ledger.get("volume_before", math.nan), ledger.get("volume_after", math.nan)
    rows = [
        ("volume before", f"{_number(before, 3)} m³"),
        ("volume after, in the simulator", f"{_number(after, 3)} m³"),
        ("difference", f"{_number(before - after, 3)} m³"),
        ("bulk density", f"{_number(ledger.get('density'), 3)} t/m³"),
        ("mass that left the pile", f"{_number(ledger.get('mass_removed'), 3)} t"),
        ("closing error", f"{_text(_percent(ledger_error(ledger)))}"),
    ]
    return _facts(rows)


def ledger_error(ledger: Mapping[str, float]) -> float:
    """How far the mass loaded is off what the volume lost weighs, relative; 0 is closed."""
    lost = ledger.get("density", math.nan) * (
        ledger.get("volume_before", math.nan) - ledger.get("volume_after", math.nan)
    )
    mass = ledger.get("mass_removed", math.nan)
    return abs(mass - lost) / max(abs(mass), abs(lost), 1e-3)


def _percent(part: float) -> str:
    return f"{100.0 * part:.2g} %" if math.isfinite(part) else "unknown"


def _ledger_warning(ledger: Mapping[str, Any]) -> str:
    error = ledger_error(ledger)
    if error <= LEDGER_TOLERANCE:
        return ""
    return (
        '<p class="warn">The ledger does not close: the loads and the volume that left the pile '
        f"differ by {_text(_percent(error))}. Do not rely on the masses.</p>"
    )


def _settings(document: Mapping[str, Any], more: Mapping[str, str]) -> str:
    pile, receiver = document.get("pile", {}), document.get("receiver", {})
    rows = [
        (name, _text(document[name]))
        for name in ("world", "model", "planner", "objective", "seed")
        if name in document
    ]
    rows += [
        (part, _text(document[part].get("name", "unnamed")))
        for part in ("soil", "machine")
        if isinstance(document.get(part), Mapping)
    ]
    if receiver:
        place = f"x {_number(receiver.get('x'))} m, y {_number(receiver.get('y'))} m"
        heading = _number(math.degrees(receiver.get("heading", math.nan)), 0)
        rows.append(("where the loader dumps", f"{place}, heading {heading}°"))
    rows += [(f"pile, {_text(name)}", _plain(value)) for name, value in pile.items()]
    rows += [(_text(name), _text(value)) for name, value in more.items()]
    return _facts(rows)


def _facts(rows: Sequence[tuple[str, str]]) -> str:
    return f'<table class="facts">{"".join(_row(row) for row in rows)}</table>'
