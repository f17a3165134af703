"""A night with six faults: what an engineer finds the next morning."""

import json
import re
from pathlib import Path

import pytest

from tests.processes.night import Night, ccatp, morning, spend

# What was wrong, as alarms, history, posts and report name it; the first two in either order.
SIX = {
    "the laser system": "measurements_failed",
    "the link": "no_frame|frames_lost",
    "the edge sensor": "edge|off_the_panel",
    "the disk": "fix_not_stored|disk_stalls",  # both limits are 30 s
    "the weather": "emergency",
    "the battery": "battery_low",
}
IN_REPORT = (
    "no reply to laserready",
    "no sensors frame",
    "edge sensor|off the panel",
    "cannot be stored|disk stalls",
    "wind 25 m/s",
    "battery has to last",
)


@pytest.mark.slow
def test_the_morning_shows_what_happened_why_who_knew_and_what_was_measured(tmp_path: Path) -> None:
    night = Night(tmp_path)
    try:
        spend(night)
        text = morning(night)
    finally:
        night.close()
    history = ccatp("alarms", "history", night.run_dir)
    for what, name in SIX.items():
        assert re.search(f"raised: .*({name})", history), what
        assert re.search(f"acknowledged by .*({name})", history), what
        posted = {post["event"] for post in night.posts.bodies if re.search(name, post["alarm"]["name"])}
        assert posted == {"raised", "acknowledged", "ended"}, what
        assert any(re.search(name, post["alarm"]["name"]) and post["alarm"]["advice"] for post in night.posts.bodies)
    report = (night.run_dir / "report.html").read_text()
    assert [words for words in IN_REPORT if not re.search(words, report)] == []
    assert "27 of 27 planned points measured" in report
    summary = json.loads((night.run_dir / "summary.json").read_text())
    assert summary["points"] == {"total": 27, "measured": 27, "first_arrival_within_10mm": 27, "skipped": 0}
    assert str(tmp_path) not in text
