"""The example of the CSV that docs/radio_data.md shows."""

import json
import re
from pathlib import Path

import pytest

from ccatp.beacons.datasets.events_csv import EVENTS
from ccatp.beacons.datasets.reader import read_run
from ccatp.cli import main

DOCS = Path(__file__).parents[3] / "docs"
EXAMPLE = DOCS / "radio_example.csv"
PAGE = DOCS / "radio_data.md"


def test_the_example_reads_without_a_warning() -> None:
    run = read_run(EXAMPLE, None, None)
    assert run.warnings == ()
    assert run.beacon_ids == ("door", "window", "desk")
    assert run.first_pose == (1.0, 1.0, 0.0)


@pytest.mark.parametrize("filter_name", ["ekf-slam", "smoother"])
def test_the_example_is_solved(filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["radio", "slam", str(EXAMPLE), "--filter", filter_name, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["trajectory_rmse_m"] < 0.15
    assert data["beacon_rmse_m"] < 0.3


def test_the_page_lists_every_event_with_its_columns() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([^`]*)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert dict(rows) == {
        event: ", ".join(columns).replace("(", "[").replace(")", "]") for event, columns in EVENTS.items()
    }


def test_the_page_shows_lines_of_the_example() -> None:
    text = PAGE.read_text(encoding="utf-8")
    shown = text.split("```text\n")[1].split("```")[0].splitlines()
    lines = EXAMPLE.read_text(encoding="utf-8").splitlines()
    assert all(line in lines for line in shown if line != "...")
