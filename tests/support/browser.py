"""The page of a run in Chromium."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from playwright.sync_api import Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run", "--disable-dev-shm-usage", "--disable-extensions",
)  # fmt: skip
PATIENCE_MS = 30_000


@contextmanager
def browser_page(port: int, runtime_dir: Path) -> Iterator[Page]:
    """The page at a port in a browser, with its token; it asks nowhere else, and nothing fails in it."""
    asked: set[str] = set()
    errors: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.set_default_timeout(PATIENCE_MS)
            page.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(f"http://127.0.0.1:{port}/?token={(runtime_dir / 'dashboard.token').read_text().strip()}")
            yield page
        finally:
            browser.close()
    assert asked == {f"127.0.0.1:{port}"}, "asked elsewhere"
    assert errors == []
