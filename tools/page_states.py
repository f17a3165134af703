"""Pictures of the page in every state of a mission: a played daemon sends what the main loop would publish.

The turn of each status is made by ``ccatp.survey.turn`` from an engagement in that state.
"""

import asyncio
import tempfile
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import msgspec
from playwright.async_api import async_playwright, expect

from ccatp.conditions import Condition, text_of
from ccatp.conditions.danger import BATTERY_LOW, EARTHQUAKE, EMERGENCY, ENCODERS_STALE, WHEEL_BLOCKED
from ccatp.conditions.mission import OPERATOR
from ccatp.config.load import load_config
from ccatp.core import ALL_MOTION, NO_MOTION, Cause, DeckPose, EventCode, PointId, Severity, Verdict
from ccatp.daemon.supervision.process import open_log
from ccatp.links.topics import LEVELS, OPERATOR_MESSAGE, Alarm, FixMessage, SeverityName, TrackMessage
from ccatp.mirror.mirror import build_mirror
from ccatp.report.dashboard.survey_view import point_name, survey_points
from ccatp.survey.engagement import Earthquake, Engagement, Faulted, Held, Kind, Over, Paused, Phase
from ccatp.survey.events import DRIVING, MEASURING, SurveyOutcome
from ccatp.survey.turn import turn_of
from tests.support.browser import CHROMIUM
from tests.support.page_rig import Rig, page_rig

expect.set_options(timeout=30_000)  # on a busy machine the played daemon may be late
CFG = load_config(None, {"run.panels": 2, "observation.operator": "Anna"})
MIRROR = build_mirror(CFG.mirror)
POINTS = survey_points(MIRROR, CFG)
SIZES = {"desktop": (1440, 900), "phone": (390, 844)}
SCHEMES: tuple[Literal["dark", "light"], ...] = ("dark", "light")
MEASURED, LEG_S = 7, 10.0
PERIOD_S, SETTLE_MS = 0.1, 800
# Messages: one of a word, and one of several lines.
LOG = (
    ("info", "resumed: turning"),
    ("warning", "measurement of the robot's place failed: Etalon server 127.0.0.1:2001: no reply to laserready within "
     "3.0 s; restart its laser driver or raise [etalon] request_timeout_s"),
)  # fmt: skip
LINE = (
    b'{"type":"sensors","seq":5,"t":1.5,"imu":[],"enc":[],"edge":[[1.5,1,1,1,1]],"gravity":null,"fans":[0.8,0.8],'
    b'"soc":0.61,"cmd":{"seq":4,"age":0.012,"permit_age":0.008,"held":false},"faults":[]}'
)


class Work(Phase, frozen=True, tag=True):
    """At work in a mode."""

    at: StrEnum

    kind = Kind.WORK

    @property
    def mode(self) -> StrEnum:
        """Public name of the phase."""
        return self.at


class Shown(NamedTuple):
    """A state: what the mission is, what danger finds, what the daemon would accept, and the active alarms."""

    engagement: Engagement
    offers: Sequence[str] = ("pause", "abort", "stop")
    found: Condition | None = None
    alarms: Sequence[Condition] = ()
    emergency: str = ""
    told: Mapping[str, Any] = {}


CALLED, BLOCKED = OPERATOR.cause(by="eva"), WHEEL_BLOCKED.cause(side="left")
STATES = {
    "waiting": Shown(Engagement()),
    "driving": Shown(Engagement(Work(DRIVING))),
    "measuring": Shown(Engagement(Work(MEASURING))),
    "held_by_itself": Shown(
        Engagement(Held(), cause=ENCODERS_STALE.cause()), found=ENCODERS_STALE, alarms=(ENCODERS_STALE,)
    ),
    "paused": Shown(Engagement(Paused(), cause=CALLED), ("resume", "abort", "stop")),
    "fault": Shown(
        Engagement(Faulted(), cause=BLOCKED), ("abort", "stop"), WHEEL_BLOCKED, (WHEEL_BLOCKED, BATTERY_LOW)
    ),
    "emergency": Shown(
        Engagement(Held(), cause=EARTHQUAKE.cause(), earthquake=Earthquake.HELD),
        ("pause", "abort", "stop", "clear"), EARTHQUAKE, (EARTHQUAKE,), "earthquake",
    ),
    "aborted": Shown(
        Engagement(Over(SurveyOutcome.AT_BASE), cause=EMERGENCY.cause(kind="weather")), (), EMERGENCY, (EMERGENCY,),
        "weather", {"exit_status": 3},
    ),
    "complete": Shown(Engagement(Over(SurveyOutcome.COMPLETE)), (), told={"exit_status": 0, "done": len(POINTS)}),
    "stopped": Shown(
        Engagement(Over(SurveyOutcome.STOPPED), cause=ENCODERS_STALE.cause()), (), ENCODERS_STALE, (ENCODERS_STALE,),
        told={"exit_status": 4, "stopped_by": "eva"},
    ),
}  # fmt: skip


def _cause(row: Condition) -> Cause:
    return row.cause(side="left", kind="weather")


def status_of(shown: Shown) -> dict[str, Any]:
    """The fields of the mission's status."""
    s = shown.engagement
    alarms = [
        Alarm(
            name=row.name, severity=cast(SeverityName, row.alarm_severity.name.lower()), cause=text_of(_cause(row)),
            advice=row.advice, since="2026-11-26T03:31:20Z", since_s=1.0,
        )
        for row in shown.alarms
    ]  # fmt: skip
    known = {
        "state": str(s.mode), "cause": text_of(s.cause), "condition": s.cause.condition, "outcome": str(s.outcome),
        "turn": turn_of(s, None, tuple(shown.offers)), "point": point_name(POINTS[MEASURED]), "t_s": 130.0,
        "elapsed_s": 130.0, "eta_s": 95.0, "done": 0 if s.kind is Kind.READY else MEASURED, "total": len(POINTS),
        "error_mm": 0.05, "grip": 10.2, "friction": 2.0, "alarms": alarms, "since_s": 122.0,
    }  # fmt: skip
    return known | dict(shown.told)


def verdict_of(shown: Shown) -> Verdict:
    """What the danger loop says of the newest frame."""
    row = shown.found
    if row is None:
        return Verdict.normal(5, 130.0)
    permits = ALL_MOTION if row.code is EventCode.ABORTED and row is not EARTHQUAKE else NO_MOTION
    cause = _cause(row)
    severity = row.severity or Severity.NONE
    return Verdict(5, 130.0, row.code, cause, "", 0.0, 0.0, *permits, severity=severity)


def measure(rig: Rig, points: Sequence[PointId]) -> None:
    """Send fixes at points, and the path between them."""
    for k, point in enumerate(points):
        x, y = MIRROR.point_on_deck(point)
        place = MIRROR.puck_world(DeckPose(x + 5e-5 * (1 + k % 3), y, 0.0), CFG.robot.puck_height_m)
        rig.main.send("fix", FixMessage(
            seq=k, t_s=LEG_S * (k + 1), point=(*point,), is_fused=True, position_m=place, covariance_m2=[0.0] * 9,
            dop=3.0, residual_rms_m=2e-6, channels=[1, 2, 3, 4], jump_mm=0.1 + 0.1 * (k % 4),
        ))  # fmt: skip
        here, panel = MIRROR.point_on_deck(point), MIRROR.panels[point.panel]
        row = (10 * k, LEG_S * (k + 1), *point.panel, here[0] - panel.x_m, here[1] - panel.y_m, 0.0, 1e-4)
        rig.main.send("track", TrackMessage(seq=k, t_s=LEG_S * (k + 1), rows=[row]))


async def _live(rig: Rig, shown: Shown) -> None:
    """The daemon reports until it is cancelled."""
    status, verdict = status_of(shown), verdict_of(shown)
    while True:
        rig.danger.send("verdict", verdict)
        rig.tell_alive(line=LINE, **status)
        await asyncio.sleep(PERIOD_S)


async def picture_states(folder: Path, names: Sequence[str]) -> None:
    """Write ``NAME_SIZE_SCHEME.png`` for the states of these names, or for all; playwright makes the folder."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for name in names or STATES:
            shown = STATES[name]
            with tempfile.TemporaryDirectory(prefix="ccatp-") as run_dir:
                if shown.emergency:
                    active = {"kind": shown.emergency, "id": "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11", "note": "reported"}
                    (Path(run_dir) / "emergencies.json").write_bytes(msgspec.json.encode({"active": [active]}))
                log = open_log(Path(run_dir) / "log.jsonl", "main")
                for level, text in LOG:
                    log.log(LEVELS[level], OPERATOR_MESSAGE, text=text)
                async with page_rig(CFG, Path(run_dir)) as rig, asyncio.TaskGroup() as tasks:
                    living = tasks.create_task(_live(rig, shown))
                    page = await browser.new_page()
                    await page.goto(f"http://127.0.0.1:{rig.port}/?token={rig.token}")
                    await expect(page.locator("#total")).to_have_text(str(len(POINTS)))
                    measure(rig, POINTS[: status_of(shown)["done"]])
                    for size, (width, height) in SIZES.items():
                        for scheme in SCHEMES:
                            await page.emulate_media(color_scheme=scheme)
                            await page.set_viewport_size({"width": width, "height": height})
                            await page.wait_for_timeout(SETTLE_MS)
                            await expect(page.locator("#alarm")).to_be_hidden()
                            path = folder / f"{name}_{size}_{scheme}.png"
                            await page.screenshot(path=path)
                            print(path)
                    await page.close()
                    living.cancel()
        await browser.close()
