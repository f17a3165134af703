"""Makes pictures in Chromium: ``python -m tools.screenshots``.

``dashboard [FOLDER]``: those of the documentation, of simulated runs of their own: waiting for the laser system,
driving, the same on a phone, held with three alarms, and done. A picture larger than ``MAX_BYTES`` is an error.
``states [FOLDER] [NAME]...``: every state of a mission before the page of a played daemon (``tools.page_states``), on a
desktop and a phone, light and dark; without a folder in ``build/screenshots``.
``report RUN_DIR``: parts of a report, for the documentation.
"""

import asyncio
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from signal import SIGSTOP

from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

from ccatp.report.run_page import report_run
from tests.support.browser import browser_page
from tests.support.dashboards import WITH_PAGE, page_port
from tests.support.runs import NO_CALIBRATION, Run
from tools.generated_docs import DOCS, ROOT
from tools.page_states import picture_states

DESKTOP, PHONE = (1440, 900), (390, 844)
MAX_BYTES = 200_000
DONE, PATIENCE_S = 110, 300.0
WAITING_MS = 20_000
SETTLE_MS = 1500  # the plots are drawn twice a second
EMERGENCIES = {"weather": "wind above 15 m/s", "earthquake": "magnitude 4 near San Pedro"}
LOW_BATTERY = """
[[fault]]
signal = "soc"
type = "stuck"
at_s = 640.0
for_s = 10000.0
value = 0.18
"""


class Camera:
    """Takes pictures of a page into a folder."""

    def __init__(self, page: Page, folder: Path) -> None:
        self._page, self._folder = page, folder

    def take(self, name: str, size: tuple[int, int] = DESKTOP) -> None:
        """One picture of the whole window."""
        self._page.set_viewport_size({"width": size[0], "height": size[1]})
        self._page.wait_for_timeout(SETTLE_MS)
        path = self._folder / f"dashboard_{name}.png"
        self._page.screenshot(path=path)
        with Image.open(path) as image:  # this way small things keep their colours
            small = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1)
        small.save(path, optimize=True)
        if path.stat().st_size > MAX_BYTES:
            raise SystemExit(f"{path}: {path.stat().st_size} bytes, at most {MAX_BYTES} belong into the documentation")
        print(f"{path}  {path.stat().st_size} bytes")


def look(folder: Path, options: tuple[str, ...], story: Callable[[Run, Page, Camera], None]) -> None:
    """Start a run with these options, open its page, and tell the story."""
    with tempfile.TemporaryDirectory(prefix="ccatp-") as sockets:
        plan = Path(sockets) / "faults.toml"
        plan.write_text(LOW_BATTERY)
        args = (*WITH_PAGE, *NO_CALIBRATION, "--faults", str(plan), *options)
        with Run(Path(sockets) / "tonight", Path(sockets), *args) as run:
            run.until(lambda status: True)
            with browser_page(page_port(run), run.runtime_dir) as page:
                story(run, page, Camera(page, folder))


def waits(run: Run, page: Page, camera: Camera) -> None:
    """The laser system does not answer."""
    run.send("etalon", SIGSTOP)
    page.wait_for_selector("#links li[data-well=yes]")
    page.wait_for_timeout(WAITING_MS)
    camera.take("waiting")


def ends(run: Run, page: Page, camera: Camera) -> None:
    """All is measured."""
    del run
    page.wait_for_selector("#ended:not([hidden])", timeout=1e3 * PATIENCE_S)
    camera.take("done")


def drives_and_is_held(run: Run, page: Page, camera: Camera) -> None:
    """In the middle of a survey, then held by an earthquake."""
    run.until(lambda status: status["done"] >= DONE and status["state"] == "driving", PATIENCE_S)
    camera.take("driving")
    camera.take("phone", PHONE)
    expect(page.locator("#alarms li")).to_have_count(1, timeout=1e3 * PATIENCE_S)  # the battery
    for kind, note in EMERGENCIES.items():
        run.ask("emergency", "emergency", kind=kind, id=f"6f1c3c1e-5a0f-4d0e-9f2b-{len(kind):012d}", note=note)
    run.until_state("held")
    expect(page.locator("#alarms li")).to_have_count(1 + len(EMERGENCIES))
    time.sleep(2.0)  # the robot comes to rest
    camera.take("held")


def picture_dashboard(folder: Path) -> None:
    """Make those of the dashboard."""
    look(folder, ("--panels", "1", "--realtime", "--set", "robot.lag_limit_s=0.15"), waits)  # the machine may be busy
    look(folder, ("--panels", "9"), ends)
    look(folder, ("--panels", "40"), drives_and_is_held)


# -- a report ----------------------------------------------------------------------------------------------------------

# Name of each file, and the sections that it shows: from the top of the first to the bottom of the last.
REPORT_PICTURES = {"report_result": ("body > header", "#panels"), "report_quality": ("#surface", "#quality")}
WIDTH_PX, MARGIN_PX, COLOURS = 1000, 12, 256


def picture_report(run_dir: Path) -> None:
    """Write those of a report into the folder of the documentation."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_file = Path(folder) / "report.html"
        report_run(run_dir, page_file)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": 800})
        page.goto(page_file.as_uri())
        for name, sections in REPORT_PICTURES.items():
            first, last = (page.locator(section).bounding_box() for section in sections)
            assert first is not None
            assert last is not None
            top = max(first["y"] - MARGIN_PX, 0.0)
            clip = {"x": 0.0, "y": top, "width": WIDTH_PX, "height": last["y"] + last["height"] + MARGIN_PX - top}
            picture = Image.open(BytesIO(page.screenshot(full_page=True, clip=clip)))  # type: ignore[arg-type]
            picture.convert("RGB").quantize(COLOURS).save(DOCS / f"{name}.png", optimize=True)
        browser.close()


def main(kind: str, *names: str) -> None:
    """Make the pictures of a kind."""
    places = [Path(name) for name in names]
    if kind == "report":
        picture_report(*places)
    elif kind == "states":
        folder, *chosen = names or (str(ROOT / "build" / "screenshots"),)
        asyncio.run(picture_states(Path(folder), chosen))
    else:
        picture_dashboard(*places or [DOCS])


if __name__ == "__main__":
    main(*sys.argv[1:])
