"""The page in a real browser beside a mission among beacons, and the report that the run ends with."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, expect

from ccatp.config.load import load_radio_config
from ccatp.config.package import configs_dir
from tests.processes.test_beacon_runs import BeaconRunProcess
from tests.processes.test_dashboard_run import WITH_PAGE, ask
from tests.processes.test_page import CHROMIUM, PATIENCE_MS, aborts_in_two_steps, browser_page, fits_a_phone

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")


@pytest.fixture
def run(tmp_path: Path, runtime_dir: Path) -> Iterator[BeaconRunProcess]:
    config = ("--config", str(configs_dir() / "zigbee.toml"))
    started = BeaconRunProcess(
        tmp_path / "run", runtime_dir, *config, "--realtime", "--json", "--set", "mission.laps=50", *WITH_PAGE
    )
    yield started
    started.end()


@pytest.mark.slow  # the page's own code is tried by test_page
def test_an_operator_looks_aborts_and_stops(run: BeaconRunProcess) -> None:
    run.until(lambda status: status["done"] >= 1)
    port = load_radio_config(run.run_dir / "config.toml").dashboard.port
    requests: list[str] = []
    errors: list[str] = []
    with browser_page(requests) as page:
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/")
        sees_a_mission_among_beacons(page)
        fits_a_phone(page)
        status, _ = ask(port, "GET", "/healthz")
        assert status == 200
        aborts_in_two_steps(page)
        expect(page.locator("#state")).to_contain_text("returning")
        page.locator("#stop").click()
        assert run.wait() == 4, run.stderr
        expect(page.locator("#ended")).to_contain_text("The daemon has ended: stopped")
        expect(page.locator("#ended")).to_contain_text(re.compile(r"\d+ of 200 waypoints reached"))
    assert {urlsplit(asked).netloc for asked in requests} == {f"127.0.0.1:{port}"}, "asked elsewhere"
    assert errors == []
    assert json.loads(run.stdout)["outcome"] == "stopped"
    assert f"report  {run.run_dir / 'report.html'}" in run.stderr
    assert "Waypoints among ZigBee beacons" in (run.run_dir / "report.html").read_text()


def sees_a_mission_among_beacons(page: Page) -> None:
    expect(page.locator("#simulation")).to_contain_text("radios")
    expect(page.locator("#title")).to_have_text("ZigBee beacons")
    expect(page.locator("#total")).to_have_text("200")
    expect(page.locator("#unit")).to_have_text("waypoints")
    expect(page.locator("#state")).to_have_text("visiting")
    expect(page.locator("#verdict")).to_contain_text("0 normal operation")
    expect(page.locator("#links li[data-well=yes]")).to_have_count(3)
    expect(page.locator("#edges")).to_be_hidden()
    expect(page.locator("#pose-xy")).to_contain_text(" m")
    expect(page.locator("#facts")).to_contain_text("beacons on the map4")
    expect(page.locator("#map")).to_have_attribute(
        "aria-label", re.compile(r"Map: robot at .* m, \d of 4 waypoints reached, \d+ other things")
    )
    expect(page.locator("#plot-error")).to_have_attribute(
        "aria-label", re.compile("latest true error [0-9.]+, 3\u03c3"), timeout=PATIENCE_MS
    )
    expect(page.locator("#plot-map")).to_have_attribute(
        "aria-label", re.compile("latest true error [0-9.]+, expected"), timeout=PATIENCE_MS
    )
    expect(page.locator("#plot-arrival")).to_be_hidden()
    drawn = "document.querySelector('#map').toDataURL()"
    first = page.evaluate(drawn)
    deadline_s = time.monotonic() + 1e-3 * PATIENCE_MS
    while page.evaluate(drawn) == first:
        assert time.monotonic() < deadline_s, "the map stands still"
