"""Pictures of a report for its page of the documentation: ``python -m tests.docs.report_pictures RUN_DIR``."""

import shutil
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image

from ccatp.report.run_page import report_run
from tests.docs.generated import DOCS

# Name of each file, and the sections that it shows: from the top of the first to the bottom of the last.
PICTURES = {"report_result": ("body > header", "#panels"), "report_quality": ("#surface", "#quality")}
WIDTH_PX, MARGIN_PX, COLOURS = 1000, 12, 256


def main(run_dir: Path) -> None:
    """Write the pictures into the folder of the documentation."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_file = Path(folder) / "report.html"
        report_run(run_dir, page_file)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": 800})
        page.goto(page_file.as_uri())
        for name, sections in PICTURES.items():
            first, last = (page.locator(section).bounding_box() for section in sections)
            assert first is not None
            assert last is not None
            top = max(first["y"] - MARGIN_PX, 0.0)
            clip = {"x": 0.0, "y": top, "width": WIDTH_PX, "height": last["y"] + last["height"] + MARGIN_PX - top}
            picture = Image.open(BytesIO(page.screenshot(full_page=True, clip=clip)))  # type: ignore[arg-type]
            picture.convert("RGB").quantize(COLOURS).save(DOCS / f"{name}.png", optimize=True)
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
