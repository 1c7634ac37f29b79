"""The service over HTTP: what is answered, refused, stopped, and guarded."""

import base64
import contextlib
import io
import json
import math
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jax.numpy as jnp
import numpy as np
import pytest
from areas import features, square
from pages import Page
from serving import MOST_BYTES, Answer, FakePlanner, Served, fake, serving

import wlplan
from wlplan import cli
from wlplan.errors import InputError
from wlplan.io import read_plan, read_scan, write_pile
from wlplan.io.readers import known_endings
from wlplan.io.summary import info
from wlplan.planning.amounts import Empty, Loads, Tonnes, Trucks
from wlplan.planning.loading import Transport
from wlplan.planning.next_loads import NextLoad
from wlplan.planning.placement import place_of
from wlplan.planning.watch import Watch
from wlplan.report.headline import headline
from wlplan.serve import guards, server
from wlplan.serve.answers import Refused
from wlplan.serve.desk import Desk, Job
from wlplan.serve.endpoints import next_load as one_load
from wlplan.serve.settings import AMOUNT, SCAN, amount_of, from_json, from_query
from wlplan.serve.uploads import ENDINGS, Uploads, shown_name
from wlplan.types import Action, Performance, Pose

__all__ = ["fake"]  # a fixture


@pytest.fixture(scope="module")
def pile_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan on disk."""
    path = tmp_path_factory.mktemp("scans") / "heap.npz"
    write_pile(path, wlplan.seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=1))
    return path


@pytest.fixture(scope="module")
def scan(pile_file: Path) -> bytes:
    """Its bytes."""
    return pile_file.read_bytes()


@pytest.fixture
def served() -> Iterator[Served]:
    """A service that answers."""
    with serving() as one:
        yield one


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary files of this process go."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    return place


def plan_of(served: Served, scan: bytes, **settings: str) -> Answer:
    query = "&".join(f"{name}={quote(value)}" for name, value in settings.items())
    return served.ask("POST", f"/plan?name=heap.npz&{query}", scan)


# --- what is answered


def test_health_says_what_there_is(served: Served) -> None:
    found = served.ask("GET", "/health").json()
    assert found["state"] == "ready"
    assert found["worlds"] == ["bowl", "other"]
    assert found["planners"][0] == "quick"
    assert "iterated_greedy" in found["planners"]
    assert found["most_bytes"] == MOST_BYTES


def test_a_scan_is_described_as_by_info(
    served: Served, scan: bytes, pile_file: Path, folder: Path
) -> None:
    answer = served.ask("POST", "/scan?name=heap.npz", scan)
    assert answer.status == 200
    found = answer.json()
    expected = info(pile_file)
    assert {name: found[name] for name in expected} == json.loads(json.dumps(expected))
    assert found["name"] == "heap.npz"
    # The raster is the surface.
    raster, pile = found["raster"], read_scan(pile_file).pile
    every = round(raster["cell"] / pile.cell_size)
    heights = np.frombuffer(base64.b64decode(raster["height"]), "<u2").reshape(raster["size"])
    shown = raster["lowest"] + raster["step"] * heights
    np.testing.assert_allclose(
        shown, np.asarray(pile.height)[::every, ::every], atol=0.51 * raster["step"]
    )
    assert raster["first"] == pytest.approx([float(v) for v in pile.origin])
    assert list(folder.iterdir()) == []


def test_a_plan_is_a_plan_json_and_can_be_had_again(
    served: Served, scan: bytes, fake: FakePlanner, tmp_path: Path
) -> None:
    answer = plan_of(served, scan, loads="2", truck="-12,3,30", seed="4", world="other")
    assert answer.status == 200
    document = answer.json()
    (tmp_path / "plan.json").write_bytes(answer.content)
    assert len(read_plan(tmp_path / "plan.json")[0].pose.x) == 2
    assert document["pile"]["file"] == "heap.npz"
    assert (document["world"], document["planner"]) == ("other", "quick")
    (call,) = fake.calls
    assert call["amount"] == Loads(2)
    assert (call["seed"], call["planner"]) == (4, "greedy")
    np.testing.assert_allclose(
        place_of(call["site"].placed_receiver), [-12.0, 3.0, math.radians(30.0)], rtol=1e-6
    )
    again = served.ask("GET", answer.headers["content-location"])
    assert again.content == answer.content
    assert again.headers["content-disposition"] == 'attachment; filename="plan.json"'


def test_the_files_of_a_plan_are_drawn_when_they_are_asked_for(
    served: Served, scan: bytes, fake: FakePlanner, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from wlplan.planning import piles
    from wlplan.report import making

    def heights(world: Any, pile: Any, plan: Any) -> np.ndarray:
        return np.stack([np.asarray(pile.height)] * len(plan.pose.x))

    monkeypatch.setattr(making, "heights_after", heights)
    assert piles.heights_after is not heights
    at = plan_of(served, scan).headers["content-location"].rsplit("/", 1)[0]
    report = served.ask("GET", f"{at}/report.html")
    assert report.status == 200
    assert "Loading plan: 2 loads from heap.npz" in Page(report.content.decode()).text
    # The report runs its own script, as if from elsewhere.
    policy = report.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    picture = served.ask("GET", f"{at}/plan.png")
    assert picture.content.startswith(b"\x89PNG")
    drawn = served.ask("GET", f"{at}/plan.geojson")
    assert {f["properties"]["kind"] for f in drawn.json()["features"]} >= {"dig", "truck"}
    missing = served.ask("GET", f"{at}/%2e%2e%2fsecret")
    assert missing.status == 404
    assert served.ask("GET", f"{at}/other.json").status == 404
    assert served.ask("GET", "/plans/none/plan.json").status == 404
    assert list(folder.iterdir()) == []


def test_a_scan_is_sent_once_and_planned_on_twice(
    served: Served, scan: bytes, fake: FakePlanner
) -> None:
    known = served.ask("POST", "/scan?name=heap.npz", scan).json()["scan"]
    for asks, amount in (
        ({"tonnes": 30}, Tonnes(30.0)),
        ({"trucks": 2, "payload": 24.5, "exchange": 10}, None),
        ({"empty": True, "remaining": None}, Empty()),
    ):
        answer = served.ask("POST", "/plan", {"scan": known, **asks})
        assert answer.status == 200, answer.content
        if amount is not None:
            assert type(fake.calls[-1]["amount"]) is type(amount)
    filled = fake.calls[1]["amount"]
    assert isinstance(filled, Trucks)
    assert (int(filled.count), float(filled.payload)) == (2, 24.5)


def test_areas_are_sent_as_geojson_and_come_with_the_plan(
    served: Served, scan: bytes, fake: FakePlanner, folder: Path
) -> None:
    closed = json.loads(features((square(-7.0, -7.0, 2.0), {"kind": "no-go"})))
    known = served.ask("POST", "/scan?name=heap.npz", scan).json()["scan"]
    answer = served.ask("POST", "/plan", {"scan": known, "keep_out": closed})
    assert answer.status == 200, answer.content
    document = answer.json()
    assert document["pile"]["keep_out"] == "keep-out.geojson"
    assert any(note.endswith("m2 from keep-out.geojson") for note in document["pile"]["notes"])
    assert str(folder) not in answer.content.decode()
    assert fake.calls[0]["site"].keep_out.sum() > 100
    at = answer.headers["content-location"].replace("plan.json", "keep-out.geojson")
    assert served.ask("GET", at).json() == closed


def test_the_next_load_is_a_plan_of_one(
    served: Served, scan: bytes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, calls = jnp.ones(()), []

    def planned(world: Any, pile: Any, **options: Any) -> NextLoad:
        calls.append(options)
        return NextLoad(
            Pose(2.0 * one, one, 0.5 * one),
            Action(0.3 * one, one, 0.3 * one, one),
            Performance(3.0 * one, 9.0 * one, 400.0 * one),
            Transport(20.0 * one, 100.0 * one),
            4.0 * one,
        )

    monkeypatch.setattr(one_load, "next_load", planned)
    answer = served.ask("POST", "/next-load?name=heap.npz&truck=-12,3,30&objective=energy", scan)
    assert answer.status == 200, answer.content
    (tmp_path / "plan.json").write_bytes(answer.content)
    plan, document = read_plan(tmp_path / "plan.json")
    assert plan.pose.x.tolist() == [2.0]
    assert document["loads"][0]["predicted"] == {"mass": 3.0, "time": 9.0, "work": 400.0}
    assert document["receiver"]["x"] == -12.0
    assert calls[0]["objective"] == "energy"
    refused = served.ask("POST", "/next-load?name=heap.npz&truck=auto", scan)
    assert "give [x, y]" in refused.error


# --- what takes long


def test_a_plan_in_the_background_tells_and_stops(
    served: Served, scan: bytes, fake: FakePlanner
) -> None:
    fake.waits = True
    answer = plan_of(served, scan, background="true")
    assert answer.status == 202
    job = answer.json()["job"]
    assert answer.headers["content-location"] == f"/jobs/{job}"
    for _ in range(1000):
        found = served.ask("GET", f"/jobs/{job}").json()
        if found.get("total"):
            break
        time.sleep(0.05)
    assert re.fullmatch(
        r"planning, \d+ s;( \d+ programs compiled;)? steps 1 of 2; cost 3\.00", found["said"]
    )
    assert (found["state"], found["done"], found["total"]) == ("running", 1, 2)
    assert served.ask("GET", "/health").json()["state"] == "busy"
    # What comes next waits, and is told so.
    second = plan_of(served, scan, background="true").json()["job"]
    waiting = served.ask("GET", f"/jobs/{second}").json()
    assert (waiting["state"], waiting["said"]) == ("waiting", "waiting for 1 before it")
    assert served.ask("POST", f"/jobs/{second}/stop").json()["state"] == "stopped"
    assert served.ask("POST", f"/jobs/{job}/stop").status == 200
    done = served.until(job, "done")
    assert done["stopped"] == "interrupted"
    plan = served.ask("GET", f"/plans/{done['plan']}/plan.json").json()
    assert plan["stopped"] == "interrupted"
    expected = headline(plan)
    assert done["headline"] == expected
    assert done["files"][:2] == ["report.html", "plan.json"]
    assert len(fake.calls) == 1


def test_whoever_goes_away_stops_what_was_asked_for(
    served: Served, scan: bytes, fake: FakePlanner
) -> None:
    fake.waits = True
    connection = served.connection()
    connection.request("POST", "/plan?name=heap.npz", scan)
    while not fake.calls:
        time.sleep(0.01)
    assert served.service.desk.pending()
    connection.close()
    for _ in range(500):
        if not served.service.desk.pending():
            break
        time.sleep(0.01)
    assert not served.service.desk.pending()


def test_requests_wait_for_each_other(served: Served, scan: bytes, fake: FakePlanner) -> None:
    fake.waits = True
    answers: list[Answer] = []
    threads = [
        threading.Thread(target=lambda: answers.append(plan_of(served, scan))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    while len(served.service.desk.pending()) < 2:
        time.sleep(0.01)
    assert len(fake.calls) <= 1
    fake.go.set()
    for thread in threads:
        thread.join(30.0)
    assert [answer.status for answer in answers] == [200, 200]
    assert len(fake.calls) == 2


def test_too_much_that_waits_is_refused() -> None:
    desk, go = Desk(), threading.Event()
    jobs = [desk.submit(lambda job: go.wait(20.0)) for _ in range(9)]
    with pytest.raises(Refused, match="8 requests wait already") as refused:
        desk.submit(lambda job: None)
    assert refused.value.status == 503
    go.set()
    assert all(job.future.result(20.0) for job in jobs)
    desk.close()


def test_what_is_stopped_without_a_result_says_so() -> None:
    desk = Desk()

    def work(job: Job) -> None:
        job.stopping.wait(20.0)
        raise KeyboardInterrupt

    job = desk.submit(work)
    job.stop()
    assert job.future.cancelled() or "stopped before" in str(job.future.exception(20.0))
    desk.close()


def test_a_watch_asks_whether_to_stop() -> None:
    stopped = threading.Event()
    watch = Watch(stop=stopped.is_set)
    with watch.ending():
        watch.spend(loading=1)
        stopped.set()
        watch.spend(loading=1)
        raise AssertionError("it goes on")
    assert (watch.stopped, watch.spent) == ("interrupted", 1.0)


# --- what is refused


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("name=heap.gif", "unknown kind of pile file '.gif'"),
        ("name=heap", "has to end in one of .npz"),
        ("", "the scan has no name"),
        ("name=heap.npz&crop=0,0,1", "crop is [0, 0, 1]: give [x0, y0, x1, y1]"),
        ("name=heap.npz&ground=/etc/passwd", "ground is '/etc/passwd': give a number"),
        ("name=heap.npz&keep_out=/etc/passwd", "keep_out is '/etc/passwd': give a GeoJSON object"),
        ("name=heap.npz&model=/etc", "there is no setting 'model' here"),
        ("name=heap.npz&band=1", "heap.npz: there is no band to choose in .npz files"),
        ("name=heap.npz&pile=500,500", "heap.npz: there is no pile at 500, 500"),
        ("name=heap.npz&scan=bundled", "a scan was sent, and another one named"),
    ],
)
def test_bad_input_is_one_line(served: Served, scan: bytes, query: str, words: str) -> None:
    answer = served.ask("POST", f"/scan?{query}", scan)
    assert answer.status == 400
    assert words in answer.error


def test_a_damaged_file_names_itself_and_no_folder(
    served: Served, scan: bytes, folder: Path
) -> None:
    answer = served.ask("POST", "/scan?name=heap.npz", scan[: len(scan) // 2])
    assert answer.status == 400
    assert answer.error.startswith("heap.npz: cannot be read")
    assert str(folder) not in answer.error
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"scan": "gone"}, "there is no such scan any more"),
        ({}, "there is no scan"),
        ({"scan": "bundled", "loads": 3, "tonnes": 5}, "loads and tonnes do not go together"),
        ({"scan": "bundled", "trucks": 3}, "trucks and payload go together"),
        ({"scan": "bundled", "exchange": 3}, "exchange goes with trucks"),
        ({"scan": "bundled", "loads": 2.5}, "loads is 2.5: give a whole number from 1 to 500"),
        ({"scan": "bundled", "loads": True}, "loads is True: give a whole number"),
        ({"scan": "bundled", "tonnes": 0}, "give a number above 0, up to 2000"),
        (
            {"scan": "bundled", "world": "os:system"},
            "world is 'os:system': give one of bowl",
        ),
        ({"scan": "bundled", "planner": "x"}, "planner is 'x': give one of quick"),
        ({"scan": "bundled", "truck": [1, 2, 3, 4]}, "truck is [1, 2, 3, 4]: give [x, y]"),
        ({"scan": "bundled", "truck": [8.0, 8.0]}, "the truck at 8.0, 8.0 is on the pile"),
        ({"scan": "bundled", "keep_out": {"type": "Point"}}, "keep-out.geojson: holds no polygon"),
    ],
)
def test_settings_are_checked(served: Served, values: dict[str, Any], words: str) -> None:
    answer = served.ask("POST", "/plan", values)
    assert answer.status in (400, 404)
    assert words in answer.error


@pytest.mark.parametrize("body", [b"{", b"[1]", b"[" * 100_000, b"\xff", b'{"scan": NaN}'])
def test_json_that_is_none_is_refused(served: Served, body: bytes) -> None:
    answer = served.ask("POST", "/plan", body, Content_Type="application/json")
    assert answer.status == 400
    assert answer.error


def test_a_fault_of_ours_is_one_line_too(
    served: Served, scan: bytes, fake: FakePlanner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("no\nway")

    from wlplan.planning import plan as planning

    monkeypatch.setattr(planning, "plan_loads", broken)
    answer = plan_of(served, scan)
    assert answer.status == 500
    assert answer.error == "this should not happen (RuntimeError: no way): please report it."
    job = plan_of(served, scan, background="true").json()["job"]
    assert "RuntimeError" in served.until(job, "failed")["error"]
    assert served.ask("GET", "/health").status == 200


def test_unknown_places_and_ways_are_refused(served: Served) -> None:
    assert served.ask("GET", "/nowhere").status == 404
    assert served.ask("GET", "/assets/..%2f..%2fapp.py").status == 404
    assert served.ask("GET", "/plan").status == 405
    assert served.ask("GET", "/jobs/none").error


# --- what is guarded


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200),
        ("localhost:99", 200),
        ("LOCALHOST", 200),
        ("[::1]:8765", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example", 403),
        ("localhost@evil.example", 403),
        ("[", 403),
        ("", 403),
    ],
)
def test_a_name_that_was_pointed_here_is_refused(served: Served, host: str, status: int) -> None:
    assert served.ask("GET", "/health", Host=host).status == status


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 404),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "https://127.0.0.1"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
        ({"Sec_Fetch_Site": "same-origin"}, 404),
    ],
)
def test_what_another_page_sends_is_refused(
    served: Served, headers: dict[str, str], status: int
) -> None:
    answer = served.ask("POST", "/jobs/none/stop", b"", **headers)
    assert answer.status == status
    own = f"http://127.0.0.1:{served.port}"
    assert served.ask("POST", "/jobs/none/stop", b"", Origin=own).status == 404
    assert not any(name.startswith("access-control") for name in answer.headers)


def test_what_is_too_large_is_refused(served: Served) -> None:
    answer = served.ask("POST", "/scan?name=a.npz", b"0" * (MOST_BYTES + 1))
    assert answer.status == 413
    assert "larger than 1 MiB" in answer.error

    # Without saying so before.
    with contextlib.closing(served.connection()) as connection:
        parts = iter([b"0" * (MOST_BYTES // 2)] * 3)
        connection.request(
            "POST",
            "/scan?name=a.npz",
            parts,
            encode_chunked=True,
            headers={"Transfer-Encoding": "chunked"},
        )
        assert connection.getresponse().status == 413
    assert served.ask("POST", "/scan?name=a.npz", b"0" * MOST_BYTES).status == 400


def test_a_line_is_logged_that_no_terminal_obeys(served: Served) -> None:
    with contextlib.closing(socket.create_connection(("127.0.0.1", served.port))) as raw:
        raw.sendall(b"GET /a%1b[31m?name=\xe2\x80\xae HTTP/1.1\r\nHost: localhost\r\n\r\n")
        raw.recv(1000)
    served.ask("GET", "/health")
    assert all(line.isascii() and line.isprintable() for line in served.lines)
    assert re.fullmatch(r"GET /health 200 \d+ B \d+ ms", served.lines[-1])
    scope = {"path": "", "raw_path": b"/\x1b[2J\n", "query_string": b"a" * 999}
    assert guards.shown_path(scope).startswith(r"/\x1b[2J\x0a?aaa")
    assert len(guards.shown_path(scope)) == 303


def test_the_page_has_labels_and_loads_only_what_is_ours(served: Served) -> None:
    answer = served.ask("GET", "/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    source = answer.content.decode()
    page = Page(source)
    assert set(page.links) == {"data:,", "assets/page.css", "assets/serve.css", "assets/serve.js"}
    for link in ("page.css", "serve.css", "serve.js"):
        assert served.ask("GET", f"/assets/{link}").status == 200
    labelled = set(re.findall(r'<label for="([\w-]+)"', source))
    fields = set(re.findall(r'<(?:input|select) id="([\w-]+)"', source)) - {"referee"}
    assert fields <= labelled
    assert " on" + "click" not in source
    script = served.ask("GET", "/assets/serve.js").content.decode()
    assert "innerHTML" not in script
    assert "http://" not in script.replace("http://www.w3.org/2000/svg", "")


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("../../etc/heap.npz", "heap.npz"),
        ("C:\\scans\\heap.npz", "heap.npz"),
        ("<img src=x>\n\x1b[31m.npz", "<img src=x>[31m.npz"),
        ("a" * 300 + ".npz", "a" * 96 + ".npz"),
    ],
)
def test_a_name_is_shown_without_folders_and_controls(name: str, shown: str) -> None:
    assert shown_name(name) == shown


def test_all_readers_of_ours_are_reached_and_no_others() -> None:
    assert set(ENDINGS) == set(known_endings())


def test_the_oldest_scans_go() -> None:
    uploads = Uploads(100)
    first = uploads.add("a.npz", b"1" * 90)
    assert uploads.find(first.id) is first
    assert uploads.add("a.npz", b"1" * 90).id == first.id
    uploads.add("b.npz", b"2" * 90)
    uploads.add("c.npz", b"3" * 90)
    with pytest.raises(Refused, match="send it again"):
        uploads.find(first.id)


def test_a_query_says_the_same_as_json() -> None:
    kinds = {**SCAN, **AMOUNT}
    asked = from_query({"name": "7.txt", "pile": "1,-2.5", "up": "y", "trucks": "2"}, kinds)
    assert asked == from_json(
        {"name": "7.txt", "pile": [1, -2.5], "up": "y", "trucks": 2, "loads": None}, kinds
    )
    assert asked["pile"] == (1.0, -2.5)
    assert amount_of({}) == Loads(15)
    for text in ("nan", "1e999", "NaN,1", "Infinity"):
        with pytest.raises(InputError):
            from_query({"tonnes": text}, kinds)
        with pytest.raises(InputError):
            from_query({"pile": text}, kinds)


# --- the command


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


def test_a_port_in_use_is_one_line(served: Served, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(["serve", "--port", str(served.port)], capsys)
    assert f"port {served.port} of 127.0.0.1 cannot be had" in said
    assert "choose another --port" in said
    assert "is no host of this machine" in refused(["serve", "--host", "no.such.invalid"], capsys)


def test_without_the_library_it_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("wlplan.serve")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert "pip install 'wlplan[serve]'" in refused(["serve"], capsys)


def test_loopback_is_told_from_the_rest() -> None:
    assert all(map(server.is_loopback, ("127.0.0.1", "localhost", "::1", "127.9.9.9")))
    assert not any(map(server.is_loopback, ("0.0.0.0", "::", "192.168.1.2", "host.example")))


@contextlib.contextmanager
def started(*words: str) -> Iterator[tuple[subprocess.Popen[str], Served]]:
    """A process that serves, and what asks it; it is interrupted at the end."""
    command = [sys.executable, "-m", "wlplan", "serve", "--cold", "--port", "0", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        try:
            found = re.fullmatch(
                r"http://[\d.]+:(\d+)/ answers: open it in a browser; Ctrl-C ends it\n", first
            )
            assert found, first
            yield process, Served(None, int(found[1]), [])  # type: ignore[arg-type]
        finally:
            process.send_signal(signal.SIGINT)


def test_it_starts_answers_and_ends_by_ctrl_c(pile_file: Path) -> None:
    with started("--host", "0.0.0.0") as (process, here):
        assert here.ask("GET", "/health").json()["worlds"][0] == "hybrid"
        described = here.ask("POST", "/scan?name=heap.npz", pile_file.read_bytes())
        assert described.json()["volume"] > 10.0
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    *lines, last = out.splitlines()
    assert last == "stopped"
    assert [line.split()[0:3] for line in lines] == [
        ["GET", "/health", "200"],
        ["POST", "/scan?name=heap.npz", "200"],
    ]
    assert "there is no password" in err
    assert "Traceback" not in err


@pytest.mark.slow
def test_ctrl_c_twice_does_not_wait_for_what_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WLPLAN_CACHE", str(tmp_path / "programs"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    with started() as (process, here):
        job = here.ask("POST", "/plan", {"scan": "bundled", "background": True}).json()["job"]
        for _ in range(600):
            found = here.ask("GET", f"/jobs/{job}").json()
            if re.search(r"planning, \d\d s", found["said"]):
                break
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode in (0, 130), (out, err)
    assert out.endswith("stopped\n")
    assert "Ctrl-C again does not wait" in err
    assert "terminate" not in err
    # It came to its end: what it has compiled is kept.
    (folder,) = (tmp_path / "programs").iterdir()
    assert list((folder / "running").iterdir()) == []


def test_a_plan_text_has_no_nan() -> None:
    from wlplan.serve.answers import document_text

    with pytest.raises(InputError, match="not finite"):
        document_text({"x": math.nan})
    assert json.load(io.StringIO(document_text({"x": 1.5}))) == {"x": 1.5}
