"""The page of the service in a real browser: Debian's Chromium, or one that CHROMIUM names.

What is planned in is a world of closed form, so that little is compiled; all else is real.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsers import CHROMIUM
from serving import Served, serving
from test_browser import SHOTS

import wlplan
from wlplan.io import write_pile
from wlplan.planning.planners import Greedy

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: .ci/run installs it"),
]

# Side of the scan, and what the page shows around one [m].
SIDE, BESIDE = 15.7, 8.0
HOSTILE = "<img src=x onerror='window.hit=1'>.npz"


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pile with flat ground on which a loader can drive, under a name that is no name."""
    path = tmp_path_factory.mktemp("scans") / "pile.npz"
    write_pile(path, wlplan.seed_pile("conical", slope=math.radians(30.0), height=2.5, seed=1))
    return path.rename(path.with_name(HOSTILE))


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A service with a planner that tries little."""
    quick = Greedy(actions=8, refine_steps=10, refined=2, poses_per_metre=0.5)
    with serving(planner=quick) as one:
        yield one


class Opened:
    """The page, and what went wrong in it."""

    def __init__(self, browser: Any, served: Served, width: int) -> None:
        self.errors: list[str] = []
        self.home = f"http://127.0.0.1:{served.port}/"
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.watch(self.page)
        self.page.goto(self.home)

    def watch(self, page: Any) -> None:
        """Keeps what a page complains of, and what it asks of others."""
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on(
            "console",
            lambda said: self.errors.append(said.text) if said.type == "error" else None,
        )
        page.on("request", lambda request: self._ask(request.url))

    def _ask(self, url: str) -> None:
        if not url.startswith((self.home, "data:", "blob:")):
            self.errors.append(f"asks for {url}")

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Where a place [m] of a square scan around zero is on the screen, while all is shown."""
        box = self.page.locator("#map").bounding_box()
        scale = (SIDE + 2.0 * BESIDE) / min(box["width"], box["height"])
        middle = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
        return middle[0] + x / scale, middle[1] - y / scale

    def shot(self, name: str) -> None:
        """Keeps what is seen."""
        SHOTS.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=SHOTS / f"{name}.png", full_page=True)


@pytest.mark.parametrize("width", [1400, 390])
def test_a_scan_is_dropped_and_planned(
    browser: Any, served: Served, scan: Path, width: int
) -> None:
    opened = Opened(browser, served, width)
    page = opened.page
    opened.shot(f"serve-empty-{width}")
    page.set_input_files("#file", str(scan))
    page.wait_for_selector("#map", state="visible")
    assert page.locator("#map-title").inner_text() == HOSTILE
    assert page.evaluate("window.hit === undefined")

    # The truck: pressed where the loader dumps, drawn the way it looks then.
    x, y = opened.point(-10.0, 4.0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 40, steps=3)
    page.mouse.up()
    assert page.locator("#truck-how").input_value() == "place"
    assert float(page.locator("#truck-heading").input_value()) == 90.0
    truck = [float(page.locator(f"#truck-{axis}").input_value()) for axis in ("x", "y")]

    # An area to keep out of.
    page.locator("input[value=area]").check()
    for place in ((5.5, 5.5), (7.0, 5.5), (7.0, 7.0), (5.5, 7.0), (5.5, 7.0)):
        page.mouse.click(*opened.point(*place))
    assert page.locator("#area-list textarea").count() == 1
    assert len(page.locator("#area-list textarea").input_value().splitlines()) == 4

    page.locator("#loads").fill("2")
    opened.shot(f"serve-asked-{width}")
    page.locator("#plan").click()
    page.wait_for_selector("#result:visible, #wrong:visible", timeout=600_000)
    assert page.locator("#wrong").is_hidden(), page.locator("#wrong").inner_text()
    assert page.locator("#loads-table tr").count() == 2
    assert page.locator("#digs circle").count() == 2
    assert page.locator("#ways polyline").count() >= 2
    assert "t/h" in page.locator("#cards").inner_text()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    opened.shot(f"serve-plan-{width}")

    plan = page.evaluate(
        "fetch(document.querySelector('#files a[href$=\"plan.json\"]').href)"
        ".then((answer) => answer.json())"
    )
    assert [plan["receiver"]["x"], plan["receiver"]["y"]] == pytest.approx(truck, abs=0.01)
    assert truck == pytest.approx([-10.0, 4.0], abs=0.3)
    assert plan["receiver"]["heading"] == pytest.approx(math.pi / 2.0)
    assert plan["pile"]["keep_out"] == "keep-out.geojson"

    # The report, which may run its own script and reach nothing here.
    with page.context.expect_page(timeout=120_000) as waited:
        page.locator("#files a", has_text="report.html").click()
    report = waited.value
    opened.watch(report)
    report.wait_for_selector("#pile[data-ready]", timeout=120_000)
    assert "Loading plan: 2 loads" in report.locator("h1").inner_text()
    assert report.evaluate("window.origin") == "null"
    report.close()
    assert opened.errors == []


def test_a_page_without_a_size_draws_nothing_and_comes_back(
    browser: Any, served: Served, scan: Path
) -> None:
    opened = Opened(browser, served, 1400)
    page = opened.page
    page.set_input_files("#file", str(scan))
    page.wait_for_selector("#map", state="visible")
    page.mouse.click(*opened.point(-10.0, 4.0))
    before = page.locator("#flipped").get_attribute("transform")
    # A tab behind another is told of a size of zero.
    resized = "display => {map.style.display = display; dispatchEvent(new Event('resize'))}"
    page.evaluate(resized, "none")
    page.locator("#truck-x").fill("-9")
    page.evaluate(resized, "")
    assert opened.errors == []
    assert page.locator("#flipped").get_attribute("transform") == before
    assert page.locator("#truck rect").count() + page.locator("#truck circle").count() > 0


def test_all_of_it_works_by_keyboard(browser: Any, served: Served, scan: Path) -> None:
    opened = Opened(browser, served, 1400)
    page = opened.page
    page.locator("#bundled").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#map", state="visible")
    page.locator("#map").focus()
    for key in ("ArrowLeft", "ArrowLeft", "Shift+ArrowUp", "Enter"):
        page.keyboard.press(key)
    first = float(page.locator("#truck-x").input_value())
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert float(page.locator("#truck-x").input_value()) == pytest.approx(first + 1.0)
    page.locator("#truck-heading").fill("45")
    assert page.locator("#truck rect").count() == 1
    page.locator("#add-area").focus()
    page.keyboard.press("Enter")
    page.keyboard.type("1, 1\n3, 1\n3, 3")
    assert page.locator("#areas polygon").count() == 1
    # The truck is on the pile: that is said, and may be mended.
    page.locator("#plan").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#wrong", state="visible", timeout=60_000)
    assert "is on the pile" in page.locator("#wrong").inner_text()
    assert page.locator("#plan").is_enabled()
    opened.shot("serve-refused-1400")
    # What the browser says of the refusal itself is no fault of the page.
    assert [error for error in opened.errors if "Failed to load resource" not in error] == []
