"""The page in a real browser, beside a played daemon: how it is laid out, and that its end is no end of the survey."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright, expect

from ccatp.config.load import load_config
from tests.contract.page_rig import page_rig

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def folder() -> Iterator[Path]:
    path = Path(tempfile.mkdtemp(prefix="ccatp-"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")
async def test_what_a_page_shows_and_that_its_end_is_not_that_of_the_survey(folder: Path) -> None:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(20_000)
        async with page_rig(load_config(None, {"run.panels": 1}), folder) as rig:
            await page.goto(f"http://127.0.0.1:{rig.port}/")
            await expect(page.locator("#state")).not_to_have_text("connecting")
            rig.tell_alive()
            await expect(page.locator("#state")).to_have_text("driving")
            await is_laid_out(page)
        await expect(page.locator("#alarm")).to_contain_text("LINK LOST")
        await expect(page.locator("#alarm-text")).to_have_text("the dashboard has ended; the survey may go on")
        await expect(page.locator("#ended")).to_be_hidden()
        await expect(page.locator("#abort")).to_be_disabled()
        await browser.close()


async def is_laid_out(page: Page) -> None:
    heights = await page.locator("figcaption:visible").evaluate_all("nodes => nodes.map(node => node.clientHeight)")
    assert len(heights) == 4
    assert max(heights) < 1.5 * min(heights)  # one line each
    await expect(page.locator("#plot-arrival")).to_have_attribute("data-empty", "")
    await expect(page.locator("#plot-arrival .uplot")).to_be_hidden()
    await expect(page.locator("figcaption", has_text="Position error")).to_contain_text("mm, 3\u03c3 dashed")
    # At one instant: a banner that comes would move them.
    places = await page.evaluate("""() => [".map", ".plots", ".side", ".log"].map(part => {
        const box = document.querySelector(part).getBoundingClientRect();
        return [box.top, box.bottom];
    })""")
    (_, map_end), (plots_top, plots_end), (_, side_end), (log_top, _) = places
    assert map_end <= 900.0  # all of the map without scrolling
    assert 0.0 < plots_top - map_end < 30.0
    assert abs(plots_end - side_end) < 60.0  # no room empty on either side
    assert log_top > plots_end
    overflows = "nodes => nodes.filter(node => node.scrollWidth > node.clientWidth).length"
    assert await page.locator("figcaption:visible").evaluate_all(overflows) == 0
