"""``python -m tools.night DIR``: a night with six faults, and what it left for the morning.

A survey of three panels on the wall clock: the laser system is silent for a minute, the link to the robot breaks, an
edge sensor sees nothing, the disk does not answer, the observatory reports the weather, the battery gets low. An
operator acknowledges each alarm and goes on; in the morning the rest is measured. A server of this process takes the
posts of the webhook. The folder gets the run, ``posts.jsonl``, and ``night.md``: the alarms with what was done.
"""

import argparse
import json
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import SIGCONT, SIGSTOP
from typing import Any

from tests.support.http_server import taking_posts
from tests.support.runs import NO_CALIBRATION, Run

PANELS = 3
SILENT_S = 60.0  # of the laser system
# Robot time from its boot; the legs between them take a few seconds each.
PLAN = """
[[link]]
type = "black_hole"
direction = "both"
at_s = {link_s}
for_s = 6.0

[[fault]]
signal = "edge_front_left"
type = "stuck"
value = 0.0
at_s = {edge_s}
for_s = 3.0
"""
BATTERY = """
[[fault]]
signal = "soc"
type = "stuck"
value = 0.05
at_s = {battery_s}
"""


def ccatp(*arguments: object) -> str:
    """Standard output of a command that must succeed."""
    command = [sys.executable, "-m", "ccatp", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout


class Night:
    """One run, its operator, and what they did."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.run_dir, self.sockets = folder, folder / "run", folder / "sockets"
        self.sockets.mkdir()
        self._server = ExitStack()
        self.posts = self._server.enter_context(taking_posts())
        self.diary: list[tuple[str, str]] = []

    def close(self) -> None:
        self._server.close()

    def note(self, text: str) -> None:
        """What the operator did."""
        self.diary.append((time.strftime("%H:%M:%S", time.gmtime()), text))
        print(*self.diary[-1], flush=True)

    @contextmanager
    def session(self, plan: str, *more: str) -> Iterator[Run]:
        """The daemon, until it ends."""
        path = self.folder / "plan.toml"
        path.write_text(plan)
        options = ["--realtime", "--panels", str(PANELS), *NO_CALIBRATION, "--faults", str(path)]
        options += ["--set", f'alarms.webhook_url="{self.posts.url}"', *more]
        with Run(self.run_dir, self.sockets, *options, has_report=True) as run:
            yield run

    def await_alarm(self, run: Run, *words: str, timeout_s: float = 150.0) -> dict[str, Any]:
        """An alarm whose cause has one of these words, and was not acknowledged yet."""
        found: list[dict[str, Any]] = []

        def is_there(status: dict[str, Any]) -> bool:
            found[:] = [
                alarm
                for alarm in status["alarms"]
                if any(word in alarm["cause"] for word in words) and not alarm["acknowledged_by"]
            ]
            return bool(found)

        run.until(is_there, timeout_s)
        self.note(f"alarm {found[0]['name']}: {found[0]['severity']}, {found[0]['cause']}")
        self.note_status()
        return found[0]

    def note_status(self) -> None:
        """The first line of ``ccatp status``: what the robot does, and who acts next."""
        self.note(
            f"status: {ccatp('status', '--runtime-dir', self.sockets).splitlines()[0].removeprefix('now').strip()}"
        )

    def resume(self, run: Run) -> None:
        """As soon as the daemon waits for it, until the robot drives."""
        run.until(lambda status: status["state"] in {"fault", "held"})
        ccatp("resume", "--runtime-dir", self.sockets)
        self.note("resumed")
        run.until_state("driving", "turning")

    def acknowledge(self, alarm: dict[str, Any]) -> None:
        ccatp("alarms", "ack", alarm["name"], "--runtime-dir", self.sockets)
        self.note(f"acknowledged {alarm['name']}")


@contextmanager
def locked(database: Path) -> Iterator[None]:
    """Nobody else can write to it meanwhile."""
    db = sqlite3.connect(database, isolation_level=None)
    try:
        db.execute("BEGIN EXCLUSIVE")
        yield
    finally:
        db.close()


def spend(night: Night) -> None:
    """The six faults, and the morning."""
    with night.session(PLAN.format(link_s=115.0, edge_s=150.0)) as run:
        run.until_state("driving", done=2)
        laser, silent_s = run.child("etalon"), time.monotonic()
        laser.send_signal(SIGSTOP)
        night.note("the laser system stands still")
        night.acknowledge(night.await_alarm(run, "laser", "measurements"))
        time.sleep(max(0.0, silent_s + SILENT_S - time.monotonic()))
        laser.send_signal(SIGCONT)
        night.note("the laser system works again")
        night.resume(run)
        night.acknowledge(night.await_alarm(run, "no sensors frame", "frames were lost"))
        night.acknowledge(night.await_alarm(run, "panel", "edge sensor", "rim"))
        run.until(lambda status: status["state"] in {"driving", "turning"})
        with locked(night.run_dir / "mission.sqlite"):
            night.note("the disk does not answer")
            night.acknowledge(night.await_alarm(run, "disk", "stored"))
        night.note("the disk works again")
        night.resume(run)
        found = json.loads(
            ccatp("emergency", "weather", "--note", "wind 25 m/s", "--json", "--runtime-dir", night.sockets)
        )
        night.note(f"emergency weather, wind 25 m/s, id {found['id'][:8]}")
        night.acknowledge(night.await_alarm(run, "weather"))
        status = run.wait(300.0)
        night.note(f"the robot is at base, the daemon ended with {status}")
    with night.session(BATTERY.format(battery_s=35.0), "--resume", "--start-held") as run:
        run.until(lambda status: "clear" in status["turn"]["offers"])
        night.note_status()
        ccatp("clear", found["id"], "--runtime-dir", night.sockets)
        night.note("the wind is gone: cleared")
        night.resume(run)
        night.acknowledge(night.await_alarm(run, "battery"))
        night.note(f"the robot is at base, the daemon ended with {run.wait(300.0)}")
    with night.session("", "--resume") as run:
        night.note("morning: the battery is charged, the rest is measured")
        night.note(f"the survey ended with {run.wait(400.0)}")


HEAD = """# A night with six faults

This simulated survey of three panels runs in real time with six faults: the laser system is silent for a minute, the
link to the robot breaks for 6 s, an edge sensor reports no panel for 3 s, the database cannot be written, the
observatory reports bad weather, and the battery becomes low. The page shows the alarms, their history and the posts of
the webhook.
`python -m tools.night FOLDER` runs this survey and writes the page; `make test-slow` repeats it as a test.
"""


def morning(night: Night) -> str:
    """What the night left, as Markdown."""
    (night.folder / "posts.jsonl").write_text("".join(json.dumps(post) + "\n" for post in night.posts.bodies))
    lines = [HEAD, "## What happened and what the operator did (UTC)", ""]
    lines += [f"* {at} {text}" for at, text in night.diary]
    lines += ["", "## `ccatp alarms history`", "", "```", ccatp("alarms", "history", night.run_dir).rstrip(), "```"]
    lines += ["", "## Posts of the webhook", "", "| event | alarm | state | cause |", "|---|---|---|---|"]
    lines += [
        f"| {post['event']} | {post['alarm']['name']} | {post['state']} | {post['alarm']['cause']} |"
        for post in night.posts.bodies
    ]
    lines += ["", "## `ccatp runs show`", "", "```", ccatp("runs", "show", night.run_dir).rstrip(), "```", ""]
    text = "\n".join(lines).replace(str(night.run_dir), "runs/night")
    return re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:2001", text)


def main() -> int:
    """Spend the night in a new folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    night = Night(folder.resolve())
    try:
        spend(night)
        (night.folder / "night.md").write_text(morning(night))
    finally:
        night.close()
    print(f"{night.folder}/night.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
