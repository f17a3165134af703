"""A page of a long mission, and fifty pages at once, as `page_load` measures: bounded memory, and all are served."""

import shutil
import socket
from contextlib import ExitStack

import pytest

from ccatp.report.dashboard.view import MAX_LINES, MAX_SAMPLES
from tests.processes.page_load import MESSAGE_EVERY_S, load
from tests.processes.test_observers import open_page

PLAYED_S, PER_S, PAGES = 7200, 600.0, 50
# Measured for 24 hours: 6 MB and 66 MB.
MOST_PAGE_MB, MOST_GROWTH_MB = 30.0, 150.0

pytestmark = pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium: the page is not tried")


@pytest.mark.slow  # a minute; the rules by which rows are left out are tried in tests/unit/dashboard
def test_two_hours_within_seconds_are_held_in_bounded_memory_and_fifty_pages_are_served() -> None:
    with load() as loaded:
        before = loaded.held()
        loaded.play(PLAYED_S, PER_S)
        left_out = PLAYED_S // MESSAGE_EVERY_S - MAX_LINES
        assert loaded.page.locator(".left-out").inner_text() == f"{left_out:,} older messages left out: see log.jsonl"
        assert loaded.page.locator("#log li").count() == MAX_LINES + 1
        values = loaded.page.locator("#plot-error").get_attribute("aria-label")
        assert values is not None
        assert MAX_SAMPLES // 2 < int(values.split()[0]) <= MAX_SAMPLES  # of 7,200 seconds
        with ExitStack() as stack:
            pages = [stack.enter_context(open_page(loaded.port)) for _ in range(PAGES)]  # each has received news
            loaded.play(MESSAGE_EVERY_S, PER_S)
            for page in pages:
                page.shutdown(socket.SHUT_RDWR)
        held = loaded.held()
        assert held.page_mb < MOST_PAGE_MB
        assert held.server_mb - before.server_mb < MOST_GROWTH_MB
