"""A dashboard that ends, in a real browser: it is no end of the survey, and the page must not say so."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.async_api import async_playwright, expect

from ccatp.config.loader import load_config
from tests.contract.page_rig import page_rig

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def folder() -> Iterator[Path]:
    path = Path(tempfile.mkdtemp(prefix="ccatp-"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")
async def test_the_end_of_the_dashboard_is_not_that_of_the_survey(folder: Path) -> None:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page()
        page.set_default_timeout(20_000)
        async with page_rig(load_config(None, {"run.panels": 1}), folder) as rig:
            await page.goto(f"http://127.0.0.1:{rig.port}/")
            await expect(page.locator("#state")).not_to_have_text("connecting")
            rig.tell_alive()
            await expect(page.locator("#state")).to_have_text("driving")
        await expect(page.locator("#alarm")).to_contain_text("LINK LOST")
        await expect(page.locator("#alarm-text")).to_have_text("the dashboard has ended; the survey may go on")
        await expect(page.locator("#ended")).to_be_hidden()
        await expect(page.locator("#abort")).to_be_disabled()
        await browser.close()
