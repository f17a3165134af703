"""The page in a real browser, beside a survey and a mission among beacons. One story each: starts take seconds."""

import http.client
import json
import re
import socket
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from ccatp.beacons.config.load import load_radio_config
from ccatp.config.package import configs_dir
from ccatp.report.dashboard.view import MAX_LINES, MAX_SAMPLES
from tests.processes.conftest import Start
from tests.processes.test_observers import ask
from tests.processes.test_replay import BeaconRun
from tests.support.browser import CHROMIUM, PATIENCE_MS, browser_page
from tests.support.dashboards import WITH_PAGE, open_page, page_port
from tests.support.runs import Run
from tools.page_load import MESSAGE_EVERY_S, load

expect.set_options(timeout=PATIENCE_MS)  # on two busy cores a robot may be held for want of frames, and go on
PHONE = {"width": 360, "height": 740}
SETTLE_S = 3.0
# The elements that are wider than the window.
BEYOND = """() => [...document.querySelectorAll("body *")]
    .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5)
    .map(e => `${e.tagName} ${e.id} ${e.className}: ${e.textContent.trim().slice(0, 60)}`)"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")


def test_an_operator_looks_and_aborts(start: Start) -> None:
    run = start("--panels", "9", *WITH_PAGE)
    run.until_state("turning", "driving")
    with browser_page(page_port(run), run.runtime_dir) as page:
        sees_a_running_survey(page)
        keeps_its_history(page, run)
        fits_a_phone(page)
        knows_keys(page)
        sees_a_dead_main_loop(page, run)
        aborts_in_two_steps(page)
        assert run.wait() == 3, run.stderr
        expect(page.locator("#ended")).to_contain_text("The daemon ended at")
        expect(page.locator("#state")).to_contain_text("returned to base; by operator")
        expect(page.locator("#alarm")).to_be_hidden()
        expect(page.locator("#abort")).to_be_disabled()


def sees_a_running_survey(page: Page) -> None:
    expect(page.locator("#simulation")).to_be_visible()
    expect(page.locator("#total")).to_have_text("81")
    expect(page.locator("#state")).to_have_attribute("data-level", "good")
    expect(page.locator("#next")).to_contain_text("the robot continues by itself")
    expect(page.locator("#code")).to_contain_text("0 normal operation")
    expect(page.locator("#links li[data-well=yes]")).to_have_count(4)
    expect(page.locator("#pose-xy")).to_contain_text(" m")
    expect(page.locator("#map")).to_have_attribute("aria-label", re.compile(r"Map: robot at .* m, \d+ of 81 points"))
    expect(page.locator("#done")).to_have_text(re.compile("^[1-9]"))
    expect(page.locator("#plot-arrival")).to_have_attribute("aria-label", re.compile("latest by the laser 0"))
    sees_the_map_move(page)


def everything(port: int) -> dict[str, Any]:
    """What a page gets that is opened now."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=1e-3 * PATIENCE_MS)
    try:
        connection.request("GET", "/events")
        answer = connection.getresponse()
        assert answer.readline() == b"event: all\n"
        state: dict[str, Any] = json.loads(answer.readline().partition(b": ")[2])
        return state
    finally:
        connection.close()


def keeps_its_history(page: Page, run: Run) -> None:
    """Another dashboard reads from the recording what it has not seen."""
    killed_s = run.ask("status")["status"]["elapsed_s"]
    run.child("dashboard").kill()
    deadline_s = time.monotonic() + 1e-3 * PATIENCE_MS
    begun: dict[str, float] = {}
    while not begun or max(begun.values()) > 0.5 * killed_s:
        assert time.monotonic() < deadline_s, f"killed at {killed_s} s, and what it shows begins at {begun}"
        with suppress(OSError):  # it is being restarted
            state = everything(page_port(run))
            rows = {"path": state["path"], "error": state["series"]["error"]}
            begun = {name: found[0][0] for name, found in rows.items() if found}
    expect(page.locator("#alarm")).to_be_hidden()


def sees_the_map_move(page: Page) -> None:
    """The robot drives: the map is drawn, and not always the same."""
    drawn = "document.querySelector('#map').toDataURL()"
    first = page.evaluate(drawn)
    deadline_s = time.monotonic() + 1e-3 * PATIENCE_MS
    while page.evaluate(drawn) == first:
        assert time.monotonic() < deadline_s, "the map stands still"


def fits_a_phone(page: Page) -> None:
    page.set_viewport_size(PHONE)  # type: ignore[arg-type]
    deadline_s = time.monotonic() + SETTLE_S
    while page.evaluate("document.documentElement.scrollWidth") > PHONE["width"]:  # what is drawn follows the size
        assert time.monotonic() < deadline_s, page.evaluate(BEYOND)
    for name in ("pause", "abort", "stop"):
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        assert box["height"] >= 44.0  # a fingertip
        assert 0.0 <= box["y"] <= PHONE["height"] - box["height"]  # in sight without scrolling
    page.set_viewport_size({"width": 1280, "height": 900})


def knows_keys(page: Page) -> None:
    expect(page.locator("#pause")).to_be_enabled()  # not while the page waits for news of a busy machine
    page.keyboard.press("p")
    expect(page.locator("#answer")).to_have_text("pause: done")
    expect(page.locator("#state")).to_have_text("paused by operator")
    expect(page.locator("#act")).to_have_text("Resume")
    page.keyboard.press("r")
    expect(page.locator("#answer")).to_have_text("resume: done")
    page.keyboard.press("a")
    expect(page.locator("#abort")).to_have_text("Confirm?")
    expect(page.locator("#abort")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("#abort")).to_have_text("Abort")
    page.keyboard.press("s")
    expect(page.locator("#stop")).to_be_focused()  # and not pressed
    page.keyboard.press("f")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("0")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")


def sees_a_dead_main_loop(page: Page, run: Run) -> None:
    for attempt in range(3):
        run.send("main")
        killed_s = time.monotonic()
        page.wait_for_selector("#alarm:not([hidden])")
        took_s = time.monotonic() - killed_s
        expect(page.locator("#alarm")).to_contain_text("LINK LOST")
        expect(page.locator("#alarm-text")).to_contain_text("the main loop")
        expect(page.locator("#alarm")).to_be_hidden()  # another one has taken over
        expect(page.locator("#links")).to_contain_text("restarted")
        if took_s < 1.0:
            return
        assert attempt < 2, f"shown after {took_s:.1f} s, three times"  # once may be somebody else's load


def aborts_in_two_steps(page: Page) -> None:
    button = page.locator("#abort")
    expect(button).to_be_enabled()
    button.dblclick()  # one wish, not two
    expect(button).to_have_text("Confirm?")
    expect(page.locator("#state")).not_to_contain_text("driving home")
    page.wait_for_timeout(500)  # longer than a double click
    button.click()
    expect(page.locator("#answer")).to_have_text("abort: done")


@pytest.mark.slow  # the page's own code is tried by test_page
def test_an_operator_looks_aborts_and_stops_among_beacons(tmp_path: Path, runtime_dir: Path) -> None:
    config = ("--config", str(configs_dir() / "zigbee.toml"))
    options = ("--realtime", "--json", "--set", "mission.laps=50", *WITH_PAGE)
    with BeaconRun(tmp_path / "run", runtime_dir, *config, *options, has_report=True) as run:
        run.until(lambda status: status["done"] >= 1)
        port = load_radio_config(run.run_dir / "config.toml").dashboard.port
        with browser_page(port, runtime_dir) as page:
            sees_a_mission_among_beacons(page)
            fits_a_phone(page)
            assert ask(port, "GET", "/healthz")[0] == 200
            aborts_in_two_steps(page)
            expect(page.locator("#state")).to_contain_text("driving home, called by operator")
            page.locator("#stop").click()
            assert run.wait() == 4, run.stderr
            expect(page.locator("#ended")).to_contain_text("The daemon ended at")
            expect(page.locator("#state")).to_contain_text("stopped where it was; by operator")
            expect(page.locator("#ended")).to_contain_text(re.compile(r"\d+ of 200 waypoints reached"))
        assert json.loads(run.stdout)["outcome"] == "stopped"
        assert f"report  {run.run_dir / 'report.html'}" in run.stderr


def sees_a_mission_among_beacons(page: Page) -> None:
    for where, text in {
        "#simulation": "radios",
        "#title": "ZigBee beacons",
        "#total": "200",
        "#unit": "waypoints",
        "#state": "visiting",
        "#code": "0 normal operation",
        "#pose-xy": " m",
        "#facts": "beacons on the map4",
    }.items():
        expect(page.locator(where)).to_contain_text(text)
    for where, text in {
        "#map": r"Map: robot at .* m, \d of 4 waypoints reached, \d+ other things",
        "#plot-error": r"latest true \(simulation\) [0-9.]+, 3\u03c3",
        "#plot-map": r"latest true \(simulation\) [0-9.]+, expected",
    }.items():
        expect(page.locator(where)).to_have_attribute("aria-label", re.compile(text))
    expect(page.locator("#links li[data-well=yes]")).to_have_count(3)
    expect(page.locator("#edges")).to_be_hidden()
    expect(page.locator("#plot-arrival")).to_be_hidden()
    sees_the_map_move(page)


# -- a long mission, and fifty pages at once, as `page_load` measures: bounded memory, and all are served --------------

PLAYED_S, PER_S, PAGES = 7200, 600.0, 50
# Measured for 24 hours: 6 MB and 66 MB.
MOST_PAGE_MB, MOST_GROWTH_MB = 30.0, 150.0


@pytest.mark.slow  # a minute; the rules by which rows are left out are tried in tests/unit/report/dashboard
def test_two_hours_within_seconds_are_held_in_bounded_memory_and_fifty_pages_are_served() -> None:
    with load() as loaded:
        before = loaded.held()
        loaded.play(PLAYED_S, PER_S)
        left_out = PLAYED_S // MESSAGE_EVERY_S - MAX_LINES
        assert (
            loaded.page.locator(".left-out").inner_text() == f"{left_out:,} older messages are not shown: see log.jsonl"
        )
        assert loaded.page.locator("#log li").count() == MAX_LINES + 1
        values = loaded.page.locator("#plot-error").get_attribute("aria-label")
        assert values is not None
        assert MAX_SAMPLES // 2 < int(values.split()[0]) <= MAX_SAMPLES  # of 7,200 seconds
        with ExitStack() as stack:
            pages = [stack.enter_context(open_page(loaded.port)) for _ in range(PAGES)]  # each has received news
            loaded.play(MESSAGE_EVERY_S, PER_S)
            for page in pages:
                page.shutdown(socket.SHUT_RDWR)
        held = loaded.held()
        assert held.page_mb < MOST_PAGE_MB
        assert held.server_mb - before.server_mb < MOST_GROWTH_MB
