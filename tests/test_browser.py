"""The pages in a real browser: Debian's Chromium, or one that CHROMIUM names."""

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browsers import CHROMIUM
from cones import wide_cone
from test_diggability_page import document

import wlplan
from wlplan.planning.piles import heights_after
from wlplan.report.diggability_page import render_map, shades_of
from wlplan.report.figures import PlanOnPile
from wlplan.report.legs import way as way_of
from wlplan.report.page import render_report
from wlplan.report.pictures import galleries_of
from wlplan.report.scene import scene_of
from wlplan.site.frame import frame_recorded
from wlplan.site.receiver import Receiver
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

# What was seen stays there, to be looked at.
SHOTS = Path(__file__).parents[1] / "out" / "pages"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: .ci/run installs it"),
]


def dug(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Takes a round hole, and says nothing true of mass and time."""
    del action
    x = pile.origin[0] + pile.cell_size * jnp.arange(pile.height.shape[0])
    y = pile.origin[1] + pile.cell_size * jnp.arange(pile.height.shape[1])
    away = jnp.hypot(x[:, None] - pose.x, y[None] - pose.y)
    hole = jnp.where(away < 1.5, jnp.maximum(pile.height - 0.4, pile.floor), pile.height)
    one = jnp.ones(())
    return pile.replace(height=hole), Performance(one, one, one)


def scene(kind: str) -> Pile:
    """A cone, one with a wall behind, or two of them."""
    pile = wlplan.seed_pile("conical", slope=math.radians(30.0), height=3.0, seed=1)
    height = np.asarray(pile.height)
    if kind == "a wall":
        wall = np.zeros_like(height)
        wall[-6:-3, 10:-10] = 2.5
        return pile.replace(ground=jnp.asarray(wall), height=jnp.maximum(pile.height, wall))
    if kind == "two piles":
        both = np.concatenate([height, 0.7 * height])
        return pile.replace(height=jnp.asarray(both))
    return pile


def way(x: float, y: float, to_x: float, to_y: float) -> list[list[float]]:
    """Straight back by 3 m, and straight to the truck."""
    cusp = x - 3.0, y
    ends = (((x, y), cusp, -1.0), (cusp, (to_x, to_y), 1.0))
    return [
        [a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), 0.5, gear]
        for a, b, gear in ends
        for part in np.linspace(0.0, 1.0, 12).tolist()
    ]


def page_of(pile: Pile, count: int, name: str = "scan.laz") -> str:
    """The page of a plan that digs all around."""
    angle = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
    soil = np.asarray(pile.height - pile.floor)
    top = np.unravel_index(int(soil.argmax()), soil.shape)
    middle = np.asarray(pile.origin) + pile.cell_size * np.array(top)
    x, y = middle[0] - 3.0 * np.cos(angle), middle[1] - 3.0 * np.sin(angle)
    plan = LoadingPlan(
        pose=Pose(jnp.asarray(x), jnp.asarray(y), jnp.asarray(angle)),
        action=Action(*(jnp.full(count, 0.5) for _ in range(4))),
    )
    heights = heights_after(dug, pile, plan)
    record = {"mass": 4.5, "time": 9.0, "work": 400.0}

    def origin(n: int) -> tuple[float, float]:
        return float(x[n] - 5.0 * np.cos(angle[n])), float(y[n] - 5.0 * np.sin(angle[n]))

    loads = [
        {
            **{"x": float(x[n]), "y": float(y[n]), "heading": float(angle[n])},
            "action": {"delta_bm": 0.65, "k_bm": 0.72, "delta_bk": 0.69, "k_bk": 0.83},
            **{"predicted": record, "simulated": record, "transport": record},
            "path": {"points": way(*origin(n), float(x.min()) - 6.0, float(y.min()))},
        }
        for n in range(count)
    ]
    sums = {quantity: count * value for quantity, value in record.items()}
    receiver = {"x": float(x.min() - 6.0), "y": float(y.min()), "heading": 2.0}
    document: dict[str, Any] = {
        "pile": {"file": name, "sha256": 64 * "0"},
        **{"world": "hybrid", "planner": "greedy", "objective": "efficiency", "seed": 0},
        "total": {
            **{"predicted": sums, "simulated": sums, "transport": sums},
            "deviation": {"mass": 0.2, "time": 0.6, "work": 30.0},
        },
        "ledger": {"volume_before": 90.0, "volume_after": 80.0, "density": 1.7, "mass_removed": 17},
        **{"loads": loads, "receiver": receiver, "notes": ["the truck stands on ground not seen"]},
        "frame": {"offset": [412000.0, 5310000.0, 0.0]},
    }
    shown = PlanOnPile(
        pile,
        plan,
        receiver=Receiver(**receiver),
        ways=[way_of(load) for load in loads],
        frame=frame_recorded(document),
    )
    each = Performance(*(np.full(count, record[name]) for name in record))
    return render_report(
        document,
        galleries=galleries_of(
            shown,
            pile.replace(height=heights[-1]),
            heights=heights,
            predicted=each,
            simulated=each,
            deviation=Performance(*(0.02 * leaf for leaf in jax.tree.leaves(each))),
        ),
        scene=scene_of(pile, heights, document),
    )


class Seen:
    """A page that was opened without a network, and what went wrong in it."""

    def __init__(self, browser: Any, source: str, width: int, folder: Path) -> None:
        self.errors: list[str] = []
        path = folder / "report.html"
        path.write_text(source)
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console",
            lambda said: self.errors.append(said.text) if said.type == "error" else None,
        )
        self.page.on("request", lambda request: self._ask(request.url, path.as_uri()))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("#pile[data-ready]", timeout=120_000)

    def _ask(self, url: str, own: str) -> None:
        if url != own and not url.startswith(("data:", "blob:")):
            self.errors.append(f"asks for {url}")

    def scrolls(self) -> list[str]:
        """Boxes with text that is cut off, but for those that are there to be scrolled."""
        cut = (
            "[...document.querySelectorAll('main *')].filter((e) => !e.closest('.wide, #pile, svg')"
            " && e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0)"
            ".map((e) => e.outerHTML.slice(0, 80))"
        )
        found: list[str] = self.page.evaluate(cut)
        return found

    def surface(self) -> float:
        """Sum of the heights that are drawn."""
        summed = "document.getElementById('pile').data[0].z.flat().reduce((a, b) => a + b, 0)"
        return float(self.page.evaluate(summed))

    def shot(self, name: str) -> None:
        """Keeps what is seen."""
        SHOTS.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=SHOTS / f"{name}.png", full_page=True)


SCENES = [("a pile", 3), ("a pile", 15), ("a pile", 80), ("a wall", 3), ("two piles", 3)]


@pytest.mark.parametrize(("kind", "count"), SCENES)
def test_the_slider_moves_the_pile(browser: Any, tmp_path: Path, kind: str, count: int) -> None:
    source = page_of(scene(kind), count)
    assert len(source) < 6_000_000
    seen = Seen(browser, source, 1400, tmp_path)
    heights = [seen.surface()]
    for n in (1, count):
        seen.page.locator("#load").fill(str(n))
        heights.append(seen.surface())
    assert heights[0] > heights[1] > heights[2]
    # From the last back to the first, by the keyboard.
    seen.page.locator("#load").focus()
    seen.page.keyboard.press("Home")
    assert seen.surface() == heights[0]
    assert seen.page.locator("#said").inner_text().startswith(f"before load 1 of {count}: at 4")
    seen.shot(f"{kind.replace(' ', '-')}-{count}-1400")
    assert seen.errors == []


@pytest.mark.parametrize("count", [3, 80])
def test_nothing_scrolls_sideways_on_a_phone(browser: Any, tmp_path: Path, count: int) -> None:
    seen = Seen(browser, page_of(scene("a pile"), count, 9 * "a-long-name-"), 390, tmp_path)
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert seen.scrolls() == []
    seen.shot(f"a-pile-{count}-390")
    assert seen.errors == []


def test_the_pile_is_turned_by_the_keyboard(browser: Any, tmp_path: Path) -> None:
    seen = Seen(browser, page_of(scene("a pile"), 3), 1400, tmp_path)
    eye = "document.getElementById('pile')._fullLayout.scene.camera.eye"
    before = seen.page.evaluate(eye)
    for name in ("Turn left", "From above"):
        seen.page.get_by_role("button", name=name).focus()
        seen.page.keyboard.press("Enter")
        seen.page.wait_for_function(f"{eye}.x !== {before['x']}")
        after = seen.page.evaluate(eye)
        assert math.hypot(after["x"] - before["x"], after["y"] - before["y"]) > 0.1
        before = after
    assert before["z"] > 5.0 * math.hypot(before["x"], before["y"])
    assert seen.errors == []


def test_a_map_is_coloured_by_what_is_chosen(browser: Any, tmp_path: Path) -> None:
    given = document(40, pile={"file": "<b onclick=alert(1)>.laz", "sha256": 64 * "0"})
    source = render_map(given, wide_cone())
    seen = Seen(browser, source, 1400, tmp_path)
    colours = "document.getElementById('pile').data[1].marker"
    for name, unit in (("mass", "t"), ("work", "kJ"), ("rate of digging", "t/h")):
        seen.page.get_by_label(name, exact=True).check()
        assert seen.page.locator("#said").inner_text().startswith(f"{name} [{unit}]: ")
        values = seen.page.evaluate(f"{colours}.color")
        shade = next(s for s in shades_of(given).values() if s.title == name)
        np.testing.assert_allclose(values, shade.values, atol=1e-3)
        assert seen.page.evaluate(f"{colours}.reversescale") is not shade.much_is_good
    # By the keyboard too.
    seen.page.get_by_label("mass", exact=True).focus()
    seen.page.keyboard.press("ArrowDown")
    assert seen.page.locator("#said").inner_text().startswith("time [s]")
    seen.shot("map-1400")
    assert seen.errors == []
    phone = Seen(browser, source, 390, tmp_path)
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert phone.scrolls() == []
    phone.shot("map-390")
    assert phone.errors == []


def test_an_old_browser_has_the_pictures(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "old.html"
    path.write_text(page_of(scene("a pile"), 3))
    page = browser.new_page()
    page.add_init_script("delete window.DecompressionStream")
    page.goto(path.as_uri())
    page.get_by_text("cannot draw in three dimensions").wait_for(timeout=30_000)
    assert page.locator("img").first.is_visible()


def test_play_goes_on_to_the_last_load_and_stops(browser: Any, tmp_path: Path) -> None:
    seen = Seen(browser, page_of(scene("a pile"), 3), 1400, tmp_path)
    seen.page.locator("#play").click()
    assert seen.page.locator("#play").inner_text() == "Pause"
    seen.page.wait_for_function("document.getElementById('load').value === '3'", timeout=60_000)
    seen.page.wait_for_function("document.getElementById('play').textContent === 'Play'")
    assert seen.page.locator("#said").inner_text() == "after all 3 loads"
    assert seen.errors == []


def test_the_print_is_complete(browser: Any, tmp_path: Path) -> None:
    seen = Seen(browser, page_of(scene("a pile"), 15), 1400, tmp_path)
    seen.page.emulate_media(media="print")
    # As wide as the sheet inside of its margins: A4 on its side, at 96 points an inch.
    seen.page.set_viewport_size({"width": 1032, "height": 700})
    seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    too_wide = (
        "[...document.querySelectorAll('table, img, pre')]"
        ".filter((e) => e.getBoundingClientRect().right > 1032)"
        ".map((e) => e.outerHTML.slice(0, 80))"
    )
    assert seen.page.evaluate(too_wide) == []
    assert seen.page.get_by_text(64 * "0").is_visible()
    assert not seen.page.locator("#pile").is_visible()
    seen.page.pdf(path=SHOTS / "print.pdf", prefer_css_page_size=True)
    assert seen.errors == []


def test_a_name_is_shown_and_never_run(browser: Any, tmp_path: Path) -> None:
    name = "</script><script>window.hit = 1</script><img src=x onerror='window.hit = 1'>.npz"
    seen = Seen(browser, page_of(scene("a pile"), 3, name), 1400, tmp_path)
    assert seen.page.evaluate("window.hit === undefined")
    assert name in seen.page.locator("h1").inner_text()
    assert seen.errors == []
