"""The page of a diggability map shows what the map says, and runs and loads nothing of others."""

import json
import math
from typing import Any

import numpy as np
import pytest
from cones import cone
from pages import Page

from wlplan.report.diggability_page import render_map, shades_of
from wlplan.report.plausibility import remarks_on_map
from wlplan.site.site import Site
from wlplan.types import Pile

HOSTILE = "</title></script>\"'><script>alert(1)</script>{{ 7 * 7 }}"
OFFSET = [412000.0, 5310000.0, 0.0]


def document(count: int = 12, **more: Any) -> dict[str, Any]:
    """A map whose place n yields n tonnes and takes 10 s more than it."""
    angle = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
    places = [
        {
            "x": -5.0 * math.cos(one),
            "y": -5.0 * math.sin(one),
            "heading": float(one),
            "mass": 3.0 + 0.1 * n,
            "time": 10.0,
            "work": 400.0 - n,
        }
        for n, one in enumerate(angle.tolist())
    ]
    return {
        "format": "wlplan.diggability/1",
        "pile": {"file": "scan.laz", "sha256": 64 * "0", "notes": ["a wall"]},
        "frame": {"offset": OFFSET, "crs": None},
        **{"soil": {"name": "gravel"}, "machine": {"name": "wa320"}, "world": "hybrid"},
        "action": {"delta_bm": 0.68, "k_bm": 4.51, "delta_bk": 0.17, "k_bk": 4.46},
        "notes": ["look out"],
        "locations": places,
        **more,
    }


def scene_of(source: str) -> dict[str, Any]:
    start = source.index('id="scene">') + len('id="scene">')
    found: dict[str, Any] = json.loads(source[start : source.index("</script>", start)])
    return found


def test_the_page_says_what_the_map_says() -> None:
    source = render_map(document(), cone(), settings={"map, wall clock": "3 s"})
    page = Page(source)
    for words in ("scan.laz", "12 places", "Look out.", "Of the scan: a wall", "gravel", "3 s"):
        assert words in page.text
    # Place 12 loads most in the same time.
    assert "number 12" in page.text
    assert "–" not in page.text
    assert len(page.links) == len(page.alts) == 4
    assert all("12 places" in (alt or "") for alt in page.alts)
    assert page.tags.count("table") == page.tags.count("caption") == 2
    assert page.scopes == page.tags.count("th")
    assert page.tags.count("input") == 4
    assert len(source) < 6_000_000
    for word in ("http:", "https:", "@import"):
        assert word not in source[: source.index('id="plotly"')]


def test_the_places_are_coloured_by_what_they_yield() -> None:
    scene = scene_of(render_map(document(), cone()))
    shades = scene["shades"]
    assert set(shades) == {"mass", "time", "work", "rate"}
    np.testing.assert_allclose(shades["rate"]["values"], 360.0 * (3.0 + 0.1 * np.arange(12)))
    assert {name for name, shade in shades.items() if shade["much"]} == {"mass", "rate"}
    assert scene["said"][0] == "place 1 at 411995.0, 5310000.0"
    np.testing.assert_allclose(np.hypot(*np.array(scene["places"]).T[:2]), 5.0, atol=0.01)


def test_a_cost_is_shown_and_orders_the_table_where_there_is_one() -> None:
    given = document()
    for n, place in enumerate(given["locations"]):
        place["cost"] = float(n)
    assert shades_of(given)["cost"].best == 0
    page = Page(render_map(given, cone()))
    assert "By cost: the best 5" in page.text
    assert "number 1\n" in page.text
    # Of all or of none.
    del given["locations"][3]["cost"]
    assert "cost" not in shades_of(given)


@pytest.mark.parametrize("count", [1, 2, 3, 11])
def test_no_place_is_among_the_best_and_the_worst(count: int) -> None:
    page = Page(render_map(document(count), cone()))
    few = min(5, count // 2)
    assert f"the best {max(few, 1)}" in page.text
    assert (f"and the worst {few}" in page.text) == (few > 0)
    # One body of the table for each half; rows of places have four numbers and their quantities.
    assert page.tags.count("tbody") == 1 + (few > 0)


def test_every_text_is_escaped() -> None:
    given = document(
        pile={"file": HOSTILE, "sha256": HOSTILE, "notes": [HOSTILE], HOSTILE: HOSTILE},
        soil={"name": HOSTILE},
        machine={"name": HOSTILE},
        world=HOSTILE,
        model=HOSTILE,
        notes=[HOSTILE],
        frame={"offset": OFFSET, "crs": HOSTILE},
    )
    source = render_map(given, cone(), settings={HOSTILE: HOSTILE})
    page, plain = Page(source), Page(render_map(document(), cone()))
    assert page.text.count(HOSTILE) > 10
    assert "<script>alert" not in source
    # Three of our own: what is drawn, what draws, and what steers it.
    assert page.tags.count("script") == plain.tags.count("script") == 3
    assert not {"link", "iframe", "object", "base"} & set(page.tags)


def test_what_to_watch_on_a_map_is_said_and_only_if_it_is_so() -> None:
    pile, given = cone(), document()
    assert remarks_on_map(given, pile, Site()) == []
    given["locations"][2] |= {"mass": 0.1, "stall_probability": 0.6}
    valid = np.ones(pile.height.shape, bool)
    valid[: pile.height.shape[0] // 2] = False
    seen = Pile(pile.height, pile.cell_size, pile.origin, valid=valid)
    said = remarks_on_map(given, seen, Site())
    assert said[0] == "1 of 12 places yields next to nothing: 0.1 t at the least"
    assert said[1] == "1 of 12 places is at the edge of a stall, with a probability of up to 60 %"
    assert "lie where the scan saw nothing" in said[2]
    slope = 0.1 * np.arange(pile.height.shape[0])[:, None] * pile.cell_size
    ground = slope * np.ones(pile.height.shape)
    tilted = pile.replace(ground=ground, height=np.asarray(pile.height) + ground)
    assert any(
        "level floors alone" in one for one in remarks_on_map(given, tilted, Site(), models=True)
    )
    assert not any("level" in one for one in remarks_on_map(given, tilted, Site()))
