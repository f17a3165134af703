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

    report = report_run(recorded, tmp_path / "report.html").path
    compare_runs(recorded, recorded, tmp_path / "compare.html")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for width in (1100, 390):
            opens_by_itself(browser, report, width, figures=4)
            opens_by_itself(browser, tmp_path / "compare.html", width, figures=5)
        what_is_cut_off_shows_it(browser, report)
        the_figures_of_two_runs_fit_a_telephone(browser, tmp_path / "compare.html")
        nothing_may_be_fetched_even_if_it_were_asked_for(browser, report)
        paper_has_the_wide_figures(browser, report)
        browser.close()


def opens_by_itself(browser: "Browser", path: Path, width: int, figures: int) -> None:
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
    shown = visible(page)
    assert len(shown) == figures
    for left, right in shown:
        assert left >= 0.0
        assert right <= width
        assert right - left > 0.8 * min(width, 880)
    page.close()


def visible(page: "Page") -> list[tuple[float, float]]:
    """Left and right ends of the figures that are shown."""
    boxes = [figure.bounding_box() for figure in page.locator("figure svg:not(.beside *):visible").all()]
    return [(box["x"], box["x"] + box["width"]) for box in boxes if box is not None]


def what_is_cut_off_shows_it(browser: "Browser", path: Path) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto(path.as_uri())
    panels = page.locator("#panels .scroll").first
    assert panels.evaluate("node => node.scrollWidth > node.clientWidth")
    assert "linear-gradient" in panels.evaluate("node => getComputedStyle(node).backgroundImage")
    panels.evaluate("node => { node.scrollLeft = 200 }")
    first = panels.locator("thead th").first.bounding_box()
    assert first is not None
    assert first["x"] >= 0.0  # the name of the row stays in sight
    page.close()


def the_figures_of_two_runs_fit_a_telephone(browser: "Browser", path: Path) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto(path.as_uri())
    assert page.locator("#figures .scroll").evaluate("node => node.scrollWidth <= node.clientWidth")
    surfaces = [figure.bounding_box() for figure in page.locator(".beside svg").all()]
    assert len(surfaces) == 2
    assert all(box is not None and box["width"] > 300.0 for box in surfaces)
    page.close()


def nothing_may_be_fetched_even_if_it_were_asked_for(browser: "Browser", path: Path) -> None:
    page = browser.new_page()
    page.goto(path.as_uri())
    blocked: list[str] = []
    page.on("console", lambda message: blocked.append(message.text))
    page.evaluate("""() => new Promise(done => { const i = new Image(); i.onerror = i.onload = done;
                     i.src = 'http://127.0.0.1:9/a.png'; document.body.append(i) })""")
    assert any("Content Security Policy" in line for line in blocked)
    page.close()


def paper_has_the_wide_figures(browser: "Browser", path: Path) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto(path.as_uri())
    page.emulate_media(media="print")
    assert page.locator(".narrow svg:visible").count() == 0
    assert page.locator(".wide svg:visible").count() == 4
    assert page.pdf(format="A4").startswith(b"%PDF")
    page.close()
