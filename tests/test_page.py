"""The report of a plan shows what is known and a dash for the rest, and loads or runs nothing."""

import base64
import copy
import functools
import math
import operator
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from pages import Page

from wlplan.errors import InputError
from wlplan.report.figures.key import KeyLine
from wlplan.report.ledger import LEDGER_TOLERANCE, ledger_error, volume_lost
from wlplan.report.page import render_report, write_report
from wlplan.report.template import Gallery, Picture

# Keys and places on the way to a value in a document.
Way = tuple[str | int, ...]

PICTURES = (Picture(b"\x89PNG one", "Ten digs"), Picture(b"\x89PNG two", "Each mass"))
GALLERIES = (
    Gallery(
        "The work",
        PICTURES[:1],
        key=[KeyLine("arrow", "#123456", "a dig"), KeyLine("unseen", "#000000", "not seen")],
        caption="A sentence.",
    ),
    Gallery("Predicted and simulated", PICTURES[1:], columns=3, small=True),
)
SETTINGS = {"planning, wall clock": "12 s"}
DASH = "–"


def performance(mass: float, time: float, work: float, **more: float) -> dict[str, float]:
    return {"mass": mass, "time": time, "work": work, **more}


DOCUMENT: dict[str, Any] = {
    "format": "wlplan.plan/1",
    "pile": {"file": "scan.npz", "sha256": "0a1b", "cells": [190, 160], "cell_size": 0.1},
    "soil": {"name": "gravel", "density": 1700.0},
    "machine": {"name": "wa320"},
    "world": "low",
    "model": "mine",
    "planner": "gradient",
    "objective": "efficiency",
    "seed": 7,
    "receiver": {"x": -9.95, "y": 5.1, "heading": -0.5236},
    "total": {
        "predicted": performance(4.4, 18.0, 1600.0, cost=4.5),
        "simulated": performance(4.0, 20.0, 1500.0, cost=5.0),
        "transport": {"time": 40.0, "work": 612.0},
    },
    "ledger": {"volume_before": 164.5, "volume_after": 162.0, "density": 1.6, "mass_removed": 4.0},
    "loads": [
        {
            "x": 2.5,
            "y": -6.75,
            "heading": math.radians(heading),
            "action": {"delta_bm": 0.65, "k_bm": 0.72, "delta_bk": 0.69, "k_bk": 0.83},
            "predicted": performance(2.2, 9.0, 800.0),
            "simulated": performance(2.0, 10.0, 750.0),
            "transport": {"time": 20.0, "work": 306.0},
            "stall_probability": 0.12,
        }
        for heading in (2.0, -6.0)
    ],
}


# Where a number that is not there leaves a dash.
NUMBERS = ("receiver", "total", "ledger", "loads")
HOSTILE = "</title></style>\"'><script>alert(1)</script>{{ 7 * 7 }}"


def rendered(document: dict[str, Any]) -> Page:
    return Page(render_report(document, galleries=GALLERIES, settings=SETTINGS))


def places(value: Any, *way: str | int) -> Iterator[tuple[Way, Any]]:
    """The way to every value inside of dicts and lists, with that value."""
    if way:
        yield way, value
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], *way, key)


def changed(way: Way, *value: Any) -> dict[str, Any]:
    """The document with another value at the end of a way; without one it is taken out."""
    document = copy.deepcopy(DOCUMENT)
    inner = functools.reduce(operator.getitem, way[:-1], cast("Any", document))
    if value:
        (inner[way[-1]],) = value
    else:
        del inner[way[-1]]
    return document


# --- laws


def test_a_whole_document_is_shown_without_a_dash() -> None:
    """So a name that the template misspells is found."""
    text = rendered(DOCUMENT).text
    assert DASH not in text
    for heading in ("Loaded", "Time", "Rate", "Energy", "Loads", "Ledger", "Settings"):
        assert heading in text
    for value in (
        "scan.npz",
        "gravel",
        "wa320",
        "mine",
        "190, 160",
        "−6.75",
        "−30°",
        "12 s",
        "12\u00a0%",
    ):
        assert value in text
    assert "Do not rely" not in text


@pytest.mark.parametrize("new", [(), (None,), (math.nan,)], ids=["missing", "null", "nan"])
def test_a_number_that_is_not_there_is_a_dash(new: tuple[float | None, ...]) -> None:
    numbers = [
        way
        for way, value in places(DOCUMENT)
        if way[0] in NUMBERS and isinstance(value, int | float)
    ]
    assert len(numbers) == 3 + 10 + 4 + 2 * 16
    for way in numbers:
        text = rendered(changed(way, *new)).text
        assert DASH in text, way
        assert not re.search(r"\b(None|nan|Undefined)\b", text), way


def test_a_part_that_is_missing_leaves_a_page() -> None:
    for way, _ in places(DOCUMENT):
        assert "What it does not tell" in rendered(changed(way)).text, way


def test_a_world_that_foresees_no_stalls_has_no_column_for_them() -> None:
    document = copy.deepcopy(DOCUMENT)
    assert "Stall" in rendered(document).text
    for load in document["loads"]:
        del load["stall_probability"]
    assert "Stall" not in rendered(document).text


@pytest.mark.parametrize("document", [{}, {"loads": []}, {"loads": [{}]}, {"ledger": None}])
def test_next_to_nothing_is_a_page_too(document: dict[str, Any]) -> None:
    text = rendered(document).text
    assert text.count(DASH) > 10
    for words in ("a pile", "an unnamed planner", "The ledger is incomplete"):
        assert words in text


def test_notes_of_the_scan_are_said() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["pile"] |= {"crs": None, "notes": ["z converted from feet to metres", HOSTILE]}
    text = rendered(document).text
    assert f"Of the scan: z converted from feet to metres; {HOSTILE}." in text
    assert "None" not in text
    document["pile"]["notes"] = 3
    assert "Of the scan" not in rendered(document).text


def test_every_text_is_escaped() -> None:
    document = copy.deepcopy(DOCUMENT)
    for way, value in places(DOCUMENT):
        if isinstance(value, str):
            inner = functools.reduce(operator.getitem, way[:-1], cast("Any", document))
            inner[way[-1]] = HOSTILE
    document["pile"][HOSTILE] = [HOSTILE]
    source = render_report(
        document,
        galleries=[
            Gallery(
                HOSTILE,
                [Picture(one.png, HOSTILE) for one in gallery.pictures],
                key=[KeyLine(line.kind, HOSTILE, HOSTILE) for line in gallery.key],
                caption=HOSTILE if gallery.caption else "",
            )
            for gallery in GALLERIES
        ],
        settings={HOSTILE: HOSTILE},
    )
    page = Page(source)
    assert "<script" not in source
    assert "script" not in page.tags
    # The title, its heading, the line below, two captions, and both sides of two settings at least.
    assert page.text.count(HOSTILE) > 10
    # Nothing of it became a tag: there is one more row of two cells, for the new entry of the pile.
    assert len(page.tags) == len(rendered(DOCUMENT).tags) + 3


def test_a_text_where_a_number_should_be_is_no_number() -> None:
    for way, value in places(DOCUMENT):
        if way[0] in NUMBERS and isinstance(value, int | float):
            page = rendered(changed(way, HOSTILE))
            assert HOSTILE not in page.text, way
            assert "script" not in page.tags, way


def test_the_page_loads_nothing() -> None:
    source = render_report(DOCUMENT, galleries=GALLERIES, settings=SETTINGS)
    page = Page(source)
    assert page.links == [
        f"data:image/png;base64,{base64.b64encode(one.png).decode()}" for one in PICTURES
    ]
    assert page.alts == [one.alt for one in PICTURES]
    assert not {"script", "link", "iframe", "object", "base"} & set(page.tags)
    for word in ("http:", "https:", "url(", "@import"):
        assert word not in source


def test_the_reader_of_pages_can_fail() -> None:
    with pytest.raises(AssertionError):
        Page("<p><b>crossed</p></b>")
    with pytest.raises(AssertionError):
        Page("<p>open")
    assert Page('<link href="https://a.b"><script></script>').links == ["https://a.b"]


# --- values


def test_numbers_are_written_for_people() -> None:
    document = changed(("total", "simulated", "work"), np.float32(1234567.0))
    assert "1,234,567" in rendered(document).text
    text = rendered(DOCUMENT).text
    assert "+10.0\u00a0%" in text  # mass, 4.4 for 4.0
    assert "−10.0\u00a0%" in text  # time, 18 for 20


def test_what_was_foreseen_stands_beside_what_was_played_with_its_interval() -> None:
    document = copy.deepcopy(DOCUMENT)
    assert "±" not in rendered(document).text
    document["total"]["deviation"] = performance(0.2, 0.5, 40.0)
    text = " ".join(rendered(document).text.split())
    # 1.645 deviations on either side; the time is 18 s of digging and 40 s of driving.
    assert "foreseen 4.4 ± 0.3 t" in text
    assert "foreseen 58 s ± 0.8 s" in text
    assert "foreseen 2.21 ± 0.07 MJ" in text
    assert "foreseen 0.27 ± 0.008 l" in text
    relative = 1.645 * math.hypot(0.2 / 4.4, 0.5 / 58.0)
    assert f"foreseen 273 ± {273.1 * relative:.0f} t/h" in text
    assert "± is half of the interval that holds nine in ten" in text
    del document["total"]["predicted"]
    assert "foreseen 4.4" not in rendered(document).text


def test_tables_have_captions_and_their_cells_have_headings() -> None:
    page = rendered({**DOCUMENT, "notes": ["look out"]})
    assert page.tags.count("table") == page.tags.count("caption") == 4
    assert page.scopes == page.tags.count("th")
    assert "Look out." in page.text


def test_one_load_is_no_loads() -> None:
    document = changed(("loads", 1))
    assert "Loading plan: 1 load from scan.npz" in rendered(document).text
    assert "Loading plan: 2 loads from scan.npz" in rendered(DOCUMENT).text


def test_a_ledger_is_closed_off_or_incomplete() -> None:
    ledger = DOCUMENT["ledger"]
    assert volume_lost(ledger) == 2.5
    assert ledger_error(ledger) <= LEDGER_TOLERANCE
    off = {**ledger, "mass_removed": 3.0}
    assert ledger_error(off) == pytest.approx(0.25)
    assert math.isnan(ledger_error({}))
    assert ledger_error({**ledger, "density": 0.0, "mass_removed": 0.0}) == 0.0
    assert "differ by\n25 %" in rendered({**DOCUMENT, "ledger": off}).text


def test_a_report_is_written_in_one_piece_or_not_at_all(tmp_path: Path) -> None:
    path = write_report(tmp_path, DOCUMENT, galleries=GALLERIES, settings=SETTINGS)
    assert [path] == list(tmp_path.iterdir())
    written = path.read_text(encoding="utf-8")
    assert written == render_report(DOCUMENT, galleries=GALLERIES, settings=SETTINGS)
    assert written.startswith("<!doctype html>\n")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(tmp_path / "missing", DOCUMENT)
