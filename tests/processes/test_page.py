"""The page in a real browser, beside a real run. One story, because browser and run take seconds to begin."""

import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import psutil
import pytest
from playwright.sync_api import Page, Request, expect, sync_playwright

from tests.processes.conftest import Run
from tests.processes.test_dashboard_run import WITH_PAGE, page_port

CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run", "--disable-dev-shm-usage", "--disable-extensions",
)  # fmt: skip
PATIENCE_MS = 30_000
expect.set_options(timeout=PATIENCE_MS)  # on two busy cores a robot may be held for want of frames, and go on
PHONE = {"width": 360, "height": 740}

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")


@contextmanager
def browser_page(requests: list[str]) -> Iterator[Page]:
    """A browser's page that notes what it asks for."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.set_default_timeout(PATIENCE_MS)
            page.on("request", lambda request: requests.append(_url(request)))
            yield page
        finally:
            browser.close()


def _url(request: Request) -> str:
    return request.url


def killed_main(run: Run) -> float:
    """Kill the main loop; returns when, s."""
    for child in psutil.Process(run.process.pid).children():
        if "ccatp.daemon.main_loop" in child.cmdline():
            child.kill()
            return time.monotonic()
    raise AssertionError("no main loop")


def test_an_operator_looks_and_aborts(start: Callable[..., Run]) -> None:
    run = start("--panels", "2", "--realtime", *WITH_PAGE)
    run.until(lambda status: status["state"] in ("turning", "driving"))
    requests: list[str] = []
    errors: list[str] = []
    with browser_page(requests) as page:
        page.on("pageerror", lambda error: errors.append(str(error)))
        url = f"http://127.0.0.1:{page_port(run)}/"
        page.goto(url)
        sees_a_running_survey(page)
        fits_a_phone(page)
        knows_keys(page)
        sees_a_dead_main_loop(page, run)
        aborts_in_two_steps(page)
        assert run.wait() == 3, run.stderr
        expect(page.locator("#ended")).to_contain_text("The daemon has ended: aborted, at base")
        expect(page.locator("#alarm")).to_be_hidden()
        expect(page.locator("#abort")).to_be_disabled()
    assert {urlsplit(asked).netloc for asked in requests} == {urlsplit(url).netloc}, "asked elsewhere"
    assert errors == []


def sees_a_running_survey(page: Page) -> None:
    expect(page.locator("#simulation")).to_be_visible()
    expect(page.locator("#total")).to_have_text("18")
    expect(page.locator("#state")).to_have_attribute("data-level", "good")
    expect(page.locator("#verdict")).to_contain_text("0 normal operation")
    expect(page.locator("#links li[data-well=yes]")).to_have_count(4)
    expect(page.locator("#pose-xy")).to_contain_text(" m")
    expect(page.locator("#map")).to_have_attribute("aria-label", re.compile(r"Map: robot at .* m, \d+ of 18 points"))
    expect(page.locator("#done")).to_have_text(re.compile("^[1-9]"))
    expect(page.locator("#plot-arrival")).to_have_attribute("aria-label", re.compile("latest arrival error 0"))
    # The robot drives: the map is drawn, and not always the same.
    drawn = "document.querySelector('#map').toDataURL()"
    first = page.evaluate(drawn)
    deadline_s = time.monotonic() + 1e-3 * PATIENCE_MS
    while page.evaluate(drawn) == first:
        assert time.monotonic() < deadline_s, "the map stands still"


def fits_a_phone(page: Page) -> None:
    page.set_viewport_size(PHONE)  # type: ignore[arg-type]
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
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
    expect(page.locator("#state")).to_contain_text("held")
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
        killed_s = killed_main(run)
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
    expect(page.locator("#state")).not_to_contain_text("returning")
    page.wait_for_timeout(500)  # longer than a double click
    button.click()
    expect(page.locator("#answer")).to_have_text("abort: done")
