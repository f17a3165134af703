"""The report in a real browser: nothing is fetched, nothing is wider than a telephone, each layout has its figures."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ccatp.report.compare import compare_runs
from ccatp.report.run_page import report_run

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt install chromium")
def test_the_pages_open_by_themselves(recorded: Path, tmp_path: Path) -> None:
    # One test with one browser: its processes end with the test.
    from playwright.sync_api import sync_playwright

    report = tmp_path / "report.html"
    report_run(recorded, report)
    compare_runs(recorded, recorded, tmp_path / "compare.html")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        opened(browser, report, 1100, figures=4).close()
        two_runs = opened(browser, tmp_path / "compare.html", 390, figures=5)
        the_figures_of_two_runs_fit_a_telephone(two_runs)
        page = opened(browser, report, 390, figures=4)
        what_is_cut_off_shows_it(page)
        nothing_may_be_fetched_even_if_it_were_asked_for(page)
        paper_has_the_wide_figures(page)
        browser.close()


def opened(browser: "Browser", path: Path, width: int, figures: int) -> "Page":
    """A page that fetches and says nothing, and is no wider than its window."""
    page = browser.new_page(viewport={"width": width, "height": 844})
    asked: list[str] = []
    said: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(path.as_uri(), wait_until="networkidle")
    assert asked == [path.as_uri()]
    assert said == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [figure.bounding_box() for figure in page.locator("figure svg:not(.beside *):visible").all()]
    shown = [(box["x"], box["x"] + box["width"]) for box in boxes if box is not None]
    assert len(shown) == figures
    for left, right in shown:
        assert left >= 0.0
        assert right <= width
        assert right - left > 0.8 * min(width, 880)
    return page


def what_is_cut_off_shows_it(page: "Page") -> None:
    panels = page.locator("#panels .scroll").first
    assert panels.evaluate("node => node.scrollWidth > node.clientWidth")
    assert "linear-gradient" in panels.evaluate("node => getComputedStyle(node).backgroundImage")
    panels.evaluate("node => { node.scrollLeft = 200 }")
    first = panels.locator("thead th").first.bounding_box()
    assert first is not None
    assert first["x"] >= 0.0  # the name of the row stays in sight


def the_figures_of_two_runs_fit_a_telephone(page: "Page") -> None:
    assert page.locator("#figures .scroll").evaluate("node => node.scrollWidth <= node.clientWidth")
    surfaces = [figure.bounding_box() for figure in page.locator(".beside svg").all()]
    assert len(surfaces) == 2
    assert all(box is not None and box["width"] > 300.0 for box in surfaces)


def nothing_may_be_fetched_even_if_it_were_asked_for(page: "Page") -> None:
    blocked: list[str] = []
    page.on("console", lambda message: blocked.append(message.text))
    page.evaluate("""() => new Promise(done => { const i = new Image(); i.onerror = i.onload = done;
                     i.src = 'http://127.0.0.1:9/a.png'; document.body.append(i) })""")
    assert any("Content Security Policy" in line for line in blocked)


def paper_has_the_wide_figures(page: "Page") -> None:
    page.emulate_media(media="print")
    assert page.locator(".narrow svg:visible").count() == 0
    assert page.locator(".wide svg:visible").count() == 4
    assert page.pdf(format="A4").startswith(b"%PDF")
