"""The report in a real browser: nothing is fetched, nothing is wider than a telephone, each layout has its figures."""

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ccatp.config.load import load_config
from ccatp.core import PointId
from ccatp.mirror.mirror import build_mirror
from ccatp.report.compare import compare_surveys
from tests.support.runs import RecordedRun

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt install chromium")
def test_the_pages_open_by_themselves(recorded_run: RecordedRun, tmp_path: Path) -> None:
    # One test with one browser: its processes end with the test.
    from playwright.sync_api import sync_playwright

    recorded = recorded_run.run_dir
    report = recorded / "report.html"
    compare_surveys(recorded, recorded, tmp_path / "compare.html")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = opened(browser, report, 1100, figures=4)
        for section in ("map", "localization"):
            a_figure_zooms_and_moves(page, section)
        the_values_under_the_pointer_are_shown(page)
        paper_has_whole_figures(page)
        page.close()
        without_script_it_can_be_read(browser, report)
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


def view_of(figure: "Locator") -> tuple[float, ...]:
    """Left, top, width and height of what a figure shows."""
    return tuple(map(float, (figure.get_attribute("viewBox") or "").split()))


def a_figure_zooms_and_moves(page: "Page", section: str) -> None:
    figure = page.locator(f"#{section} .wide svg")
    figure.scroll_into_view_if_needed()
    whole, picture = view_of(figure), figure.screenshot()
    box = figure.bounding_box()
    assert box is not None
    at = box["x"] + 0.25 * box["width"], box["y"] + 0.25 * box["height"]
    page.mouse.move(*at)
    page.mouse.down()
    page.mouse.move(at[0] + 40.0, at[1])
    page.mouse.up()
    assert view_of(figure) == whole  # there is nothing to move to
    page.mouse.move(*at)
    page.keyboard.down("Control")
    page.mouse.wheel(0.0, -100.0)
    page.wait_for_function("figure => figure.classList.contains('zoomed')", arg=figure.element_handle())
    page.keyboard.up("Control")
    zoomed = view_of(figure)
    assert zoomed[2] < 0.7 * whole[2]
    # What was under the pointer stays there; the page does not move.
    assert zoomed[0] + 0.25 * zoomed[2] == pytest.approx(whole[0] + 0.25 * whole[2], abs=0.5)
    assert figure.bounding_box() == pytest.approx(box)
    assert figure.screenshot() != picture
    page.mouse.down()
    page.mouse.move(at[0] - 100.0, at[1] - 50.0, steps=5)
    page.mouse.up()
    moved = view_of(figure)
    scale = zoomed[2] / box["width"]
    assert moved == pytest.approx((zoomed[0] + 100.0 * scale, zoomed[1] + 50.0 * scale, *zoomed[2:]), abs=0.5)
    bar = page.locator(f"#{section} .wide .zoom")
    bar.get_by_title("zoom in").click()
    assert view_of(figure)[2] == pytest.approx(0.5 * moved[2])
    bar.get_by_title("show all").click()
    assert view_of(figure) == pytest.approx(whole)
    assert figure.screenshot() == picture


def the_values_under_the_pointer_are_shown(page: "Page") -> None:
    mirror = build_mirror(load_config().mirror)
    page.locator("#map .wide .zoom").get_by_title("zoom in").click()
    dots = page.locator("#map .wide svg use:has(title)")
    seen = 0
    for dot in dots.all():
        box, title = dot.bounding_box(), dot.locator("title").text_content() or ""
        assert box is not None
        place = mirror.point_on_deck(PointId(*map(int, title.split(":")[0].split("/"))))
        dot.dispatch_event(
            "pointermove", {"clientX": box["x"] + box["width"] / 2, "clientY": box["y"] + box["height"] / 2}
        )
        reported = re.findall(r"m \(deck frame\): ([-\d.e]+)", page.locator("#map .wide output").text_content() or "")
        if reported:  # it is in sight
            assert [float(value) for value in reported] == pytest.approx(place, abs=0.02)  # two pixels of the whole
            seen += 1
    assert seen >= 3


def paper_has_whole_figures(page: "Page") -> None:
    figure = page.locator("#map .wide svg")
    assert "zoomed" in (figure.get_attribute("class") or "")
    page.pdf(format="A4")
    page.wait_for_function("figure => !figure.classList.contains('zoomed')", arg=figure.element_handle())


def without_script_it_can_be_read(browser: "Browser", path: Path) -> None:
    page = browser.new_page(java_script_enabled=False, viewport={"width": 1100, "height": 844})
    page.goto(path.as_uri())
    assert page.locator("figure svg:visible").count() == 4
    assert page.locator("button").count() == 0
    assert page.locator("#panels tbody tr").first.is_visible()
    page.close()


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
