"""The page in Chromium before a played daemon: what an operator sees, and what is sent when a button is pressed."""

import asyncio
import json
import re
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import pytest_asyncio
from playwright.async_api import Browser, Page, async_playwright, expect

from ccatp.conditions import text_of
from ccatp.conditions.danger import EMERGENCY, ENCODERS_STALE, WHEEL_BLOCKED
from ccatp.conditions.mission import FRAME_LATE, NO_WAY_ON, OPERATOR
from ccatp.config.load import load_config
from ccatp.core import Cause
from ccatp.links.topics import Alarm, FixMessage, TrackMessage, Turn
from ccatp.report.dashboard.history import Growing
from tests.support.leaks import no_new_tasks
from tests.support.page_rig import Rig, page_rig

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
# One event loop of the file: it is that of its one browser.
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser"),
    pytest.mark.asyncio(loop_scope="module"),
]
CFG = load_config(
    None,
    {
        "run.panels": 2,
        "mission.arrival_tolerance_m": 0.012,
        "health.battery_reserve": 0.31,
        "observation.operator": "Anna",
    },
)
LINE = json.dumps({
    "type": "sensors", "seq": 5, "t": 1.5, "imu": [], "enc": [], "edge": [[1.5, 1, 0, 1, 1]], "gravity": None,
    "fans": [0.8, 0.5], "soc": 0.3, "cmd": {"seq": 4, "age": 0.012, "permit_age": 0.008, "held": False}, "faults": [],
}).encode()  # fmt: skip
# Texts and circles that are drawn on the map, each with its place, and where lines begin; the newest drawing alone.
SPY = """
window.drawn = {texts: [], circles: [], begun: 0};
const proto = CanvasRenderingContext2D.prototype;
const {clearRect, fillText, arc, moveTo} = proto;
const isMap = (pen) => pen.canvas.id === "map";
proto.clearRect = function (...box) {
  if (isMap(this)) window.drawn = {texts: [], circles: [], begun: 0};
  return clearRect.apply(this, box);
};
proto.fillText = function (text, x, y) {
  if (isMap(this)) window.drawn.texts.push([text, x, y, this.measureText(text).width, parseFloat(this.font)]);
  return fillText.call(this, text, x, y);
};
proto.moveTo = function (x, y) {
  if (isMap(this)) window.drawn.begun++;
  return moveTo.call(this, x, y);
};
proto.arc = function (x, y, r, ...rest) {
  if (isMap(this)) window.drawn.circles.push([x, y, r]);
  return arc.call(this, x, y, r, ...rest);
};
"""


class Operator:
    """A browser at the page of a played daemon; its loops report all the time, unless they are ``silent``."""

    def __init__(self, page: Page, rig: Rig, folder: Path) -> None:
        self.page, self.rig, self.folder = page, rig, folder
        self.status: dict[str, Any] = {}
        self.silent = False

    async def until(self, script: str, wanted: object) -> None:
        """Evaluate until the result is as wanted."""
        found: object = None
        for _ in range(400):
            found = await self.page.evaluate(script)
            if found == wanted:
                return
            await self.page.wait_for_timeout(50)
        raise AssertionError(f"{script}: {found}, not {wanted}")

    async def report(self) -> None:
        """Both loops report; the mission is as in ``status``."""
        while True:
            if not self.silent:
                self.rig.tell_alive(line=LINE, **{"t_s": 0.0, **self.status})
            await asyncio.sleep(0.05)

    async def until_text(self, where: str, wanted: str) -> None:
        """Wait until the text of an element is this."""
        await self.until(f"document.querySelector({json.dumps(where)})?.textContent", wanted)


@pytest_asyncio.fixture(loop_scope="module")
async def no_task_leaks() -> AsyncIterator[None]:
    """As everywhere, in the event loop of this file."""
    async with no_new_tasks():
        yield


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser() -> AsyncIterator[Browser]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        await browser.close()


@pytest_asyncio.fixture(loop_scope="module")
async def operator(browser: Browser, runtime_dir: Path) -> AsyncIterator[Operator]:
    errors: list[str] = []
    async with page_rig(CFG, runtime_dir) as rig:
        # A context of its own: nothing is remembered from the page of another test.
        context = await browser.new_context(viewport={"width": 1440, "height": 900}, color_scheme="dark")
        page = await context.new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: errors.append(str(error)))
        await page.add_init_script(SPY)
        await page.goto(f"http://127.0.0.1:{rig.port}/?token={rig.token}")
        operator = Operator(page, rig, runtime_dir)
        reports = asyncio.create_task(operator.report())
        try:
            yield operator
        finally:
            reports.cancel()
            await asyncio.wait([reports])
            await context.close()
    assert errors == []


async def test_the_map_shows_the_planned_points_then_the_whole_mirror(operator: Operator) -> None:
    points = "window.drawn.circles.slice(1, 19).map(([x]) => x)"  # the planned ones, which are drawn after the base
    across = f"Math.max(...{points}) - Math.min(...{points})"
    width = await operator.page.evaluate("document.querySelector('#map').clientWidth")
    await operator.until(f"{across} > {0.5 * width}", True)  # two panels of 77
    await operator.page.locator("#fit").click()
    await operator.until(f"{across} < {0.4 * width}", True)
    await operator.until_text("#fit", "Points")


async def test_panels_have_their_numbers_where_there_is_room_and_over_no_point(operator: Operator) -> None:
    await operator.page.locator("#fit").click()
    await operator.until("window.drawn.texts.some(([text]) => text === '5-5')", True)
    drawn = await operator.page.evaluate("window.drawn")
    assert len(drawn["texts"]) == 77
    assert min(size for *_, size in drawn["texts"]) >= 8.0
    points = [(x, y, r) for x, y, r in drawn["circles"] if r < 5.0]
    assert len(points) >= 18
    for text, x, y, width, size in drawn["texts"]:
        for px, py, r in points:
            beside = max(abs(px - x) - width / 2, 0.0), max(abs(py - y) - size / 2, 0.0)
            assert max(beside) >= r, text
    await operator.page.set_viewport_size({"width": 390, "height": 844})
    await operator.until("window.drawn.texts.length", 0)


def rows_of(where: str, text: str) -> str:
    """Script for level and text of each row of a list."""
    return f"[...document.querySelectorAll('{where}')].map(row => [row.dataset.level, {text}])"


def alarm(name: str, severity: Any, **fields: Any) -> Alarm:
    known = {"cause": f"cause of {name}", "advice": "look", "since": "2026-11-26T03:00:00Z", "since_s": 1.0}
    return Alarm(name=name, severity=severity, **{**known, **fields})


def held(kind: str, actor: str, then: str, why: Cause, *offers: str) -> dict[str, Any]:
    turn = Turn(kind=kind, actor=actor, next=then, why=why, offers=offers)
    return {"state": "held", "cause": text_of(why), "condition": why.condition, "turn": turn}


async def test_the_line_says_whose_turn_it_is_and_has_the_one_button_that_is_accepted(operator: Operator) -> None:
    called = OPERATOR.cause(by="eva")
    operator.status = held("paused", "operator", "resume", called, "resume", "abort", "stop")
    await operator.until_text("#state", "paused by eva")
    await operator.until_text("#next", "Next: an operator: resume")
    await operator.until("document.querySelector('#act').hidden", False)
    await operator.until("document.querySelector('#pause').disabled", True)
    await operator.until("document.querySelector('#eta').textContent", "\u2013")
    await operator.page.locator("#act").click()
    await operator.until_text("#answer", "resume: done")
    assert [one["cmd"] for one in operator.rig.asked] == ["resume"]
    operator.status = held("faulted", "operator", "hands", WHEEL_BLOCKED.cause(side="left"), "abort", "stop")
    await operator.until("document.querySelector('#act').hidden", True)
    await operator.until("document.querySelector('#resume').disabled", True)
    await operator.until("/^status \\d\\.\\d s old$/.test(document.querySelector('#age').textContent)", True)
    operator.rig.stop.set()  # the dashboard ends; the survey may go on
    await expect(operator.page.locator("#age")).to_contain_text("no daemon answers")


async def test_the_commands_do_not_move_while_one_is_pressed_and_a_double_click_is_one(operator: Operator) -> None:
    place = "JSON.stringify(document.querySelector('#abort').getBoundingClientRect())"
    offers = ("pause", "abort", "stop")
    operator.status = {"turn": Turn(kind="work", offers=offers)}
    await operator.until("document.querySelector('#abort').disabled", False)
    before = await operator.page.evaluate(place)
    await operator.page.locator("#abort").click()
    await operator.until_text("#abort", "Confirm?")
    operator.silent = True
    await operator.page.wait_for_selector("#alarm:not([hidden])")
    assert await operator.page.evaluate(place) == before
    assert operator.rig.asked == []
    await operator.page.locator("#abort").click()
    operator.silent = False
    await operator.until_text("#answer", "abort: done")
    assert [one["cmd"] for one in operator.rig.asked] == ["abort"]
    operator.status = held("paused", "operator", "resume", OPERATOR.cause(by="eva"), "resume", *offers)
    await operator.until("document.querySelector('#act').hidden", False)
    assert await operator.page.evaluate(place) == before
    box = await operator.page.locator("#abort").bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await operator.page.mouse.click(*middle)
    await operator.page.wait_for_timeout(450)  # as long as a slow double click takes
    await operator.page.mouse.move(*middle)
    await operator.page.mouse.down(click_count=2)
    await operator.page.mouse.up(click_count=2)
    await operator.until_text("#abort", "Confirm?")
    assert len(operator.rig.asked) == 1


async def test_after_the_end_alarms_stay_and_nothing_is_offered(operator: Operator) -> None:
    why = ENCODERS_STALE.cause()
    operator.status = {
        **held("over", "operator", "hands", why), "state": "done", "outcome": "stopped", "stopped_by": "eva",
        "exit_status": 4, "alarms": [alarm("encoders_stale", "hold")],
    }  # fmt: skip
    latched = {"active": [{"kind": "fire", "id": "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11", "note": "smoke"}]}
    (operator.folder / "emergencies.json").write_bytes(msgspec.json.encode(latched))
    await operator.until_text("#state", "stopped where it was; by eva, held before: encoder samples stale")
    await operator.until_text("#alarms-head", "Alarms active at the end")
    await operator.until("document.querySelectorAll('#alarms li').length", 1)
    await operator.until("document.querySelectorAll('#alarms button, #emergencies button').length", 0)
    await operator.until("[...document.querySelectorAll('.controls button')].every(one => one.disabled)", True)
    await operator.until("document.querySelector('#permit-forward').dataset.on ?? ''", "")
    operator.rig.stop.set()
    await operator.page.wait_for_selector("#ended:not([hidden])")
    assert await operator.page.locator("#utc-name").text_content() == "last seen, UTC"


async def test_terms_are_explained_on_a_tap(operator: Operator) -> None:
    await operator.until("document.querySelectorAll('#gauges [data-term]').length >= 5", True)
    await operator.page.locator("#gauges [data-term=dop]").click()
    await operator.until("document.querySelector('#explain').textContent.startsWith('DOP, dilution of')", True)


async def test_a_pause_is_no_alarm_and_a_fault_is_one_in_colour_and_in_words(operator: Operator) -> None:
    state = "document.querySelector('#state').dataset.level"
    operator.status = held("paused", "operator", "resume", OPERATOR.cause(by="eva"), "resume")
    await operator.until(state, "note")
    await operator.until_text("#held", "held by the mission")
    operator.status = held("held", "robot", "wait", FRAME_LATE.cause(late_ms=60.0, limit_ms=50.0))
    await operator.until(state, "warn")
    alarms = [alarm(str(k), severity) for k, severity in enumerate(("fault", "slow", "inform"))]
    ended = alarm(
        "old", "hold", ended="2026-11-26T03:10:00Z", acknowledged_by="anna", acknowledged="2026-11-26T03:11:00Z"
    )
    faulted = held("faulted", "operator", "resume", NO_WAY_ON.cause(why="rim"), "resume")
    operator.status = {**faulted, "alarms": [*alarms, ended]}
    await operator.until(state, "bad")
    rows = rows_of("#alarms li", "row.querySelector('b').textContent")
    await operator.until(rows, [["bad", "■ fault"], ["warn", "▲ slow"], ["note", "● inform"], ["", "\u2013 hold"]])
    await operator.until("getComputedStyle(document.querySelector('#state'), '::before').content", '"■ "')
    operator.status = {"state": "driving"}
    await operator.until_text("#held", "follow the drives")
    await operator.until("document.querySelector('#edge-1').dataset.on", "no")
    await operator.until("document.querySelector('#edges').title", "Edge sensors off the panel: front right")


async def test_times_names_and_values_with_their_limits(operator: Operator) -> None:
    begun = {"event": "run_started", "timestamp": "2026-11-26T03:31:20.3Z"}
    (operator.folder / "log.jsonl").write_text(json.dumps(begun) + "\n")
    operator.status = {"elapsed_s": 5.0, "eta_s": 3600.0}
    await operator.until_text("#operator", "operator")
    await operator.until_text(".run .about", "survey byAnna")
    await operator.until_text("#run", operator.folder.name)
    await operator.until("document.querySelector('#started').textContent.endsWith('03:31:20')", True)
    for where, form in (("#utc", r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d"), ("#finish", r"(\d{4}-\d\d-\d\d )?\d\d:\d\d")):
        await operator.until(
            f"new RegExp({json.dumps(f'^{form}$')}).test(document.querySelector('{where}').textContent)", True
        )
    fix = FixMessage(
        seq=9, t_s=1.0, point=None, is_fused=True, position_m=(0.0, 0.0, 0.0), covariance_m2=[0.0] * 9, dop=25.0,
        residual_rms_m=2e-6, channels=[1, 2, 3, 4], jump_mm=0.7,
    )  # fmt: skip
    operator.rig.main.send("fix", fix)
    rows = rows_of("#gauges > div", r"row.innerText.replace(/\s+/g, ' ')")
    await operator.until(rows + ".slice(0, 5)", [
        ["bad", "battery low 30 % ≥ 31 %"], ["", "fan left 80 %"], ["", "fan right 50 %"],
        ["bad", "laser DOP high 25.0 ≤ 20.0"], ["", "laser residual 2.0 µm ≤ 5000 µm"],
    ])  # fmt: skip
    await operator.until(rows + ".slice(7)", [["", "permit, age 8 ms ≤ 150 ms"], ["", "drive, age 12 ms ≤ 200 ms"]])


def track(t_s: float, x_m: float) -> TrackMessage:
    return TrackMessage(seq=round(10 * t_s), t_s=t_s, rows=[(10 * round(t_s), t_s, 1, 2, x_m, 0.05, 0.0, 0.001)])


async def test_plots_are_zoomed_by_dragging_and_keep_their_history_when_the_page_is_loaded_again(
    operator: Operator,
) -> None:
    operator.status = {"t_s": 0.0, "elapsed_s": 0.0}
    await operator.until("document.querySelector('#plot-jump').closest('figure').hidden", True)
    await operator.page.locator("#engineer").check()
    for k in range(100):
        operator.rig.main.send("fix", FixMessage(
            seq=k, t_s=float(k), point=None, is_fused=True, position_m=(0.0, 0.0, 0.0), covariance_m2=[0.0] * 9,
            dop=1.0, residual_rms_m=1e-6, channels=[1, 2, 3, 4], jump_mm=0.1 + k,
        ))  # fmt: skip
        operator.rig.main.send("track", track(float(k), 0.001 * k))
    latest = "document.querySelector('#plot-jump').getAttribute('aria-label')"
    await operator.until(latest, "100 values, latest moved by the fix 99.100")
    await operator.page.reload()
    await operator.until(latest, "100 values, latest moved by the fix 99.100")
    over = operator.page.locator("#plot-jump .u-over")
    box = await over.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    await operator.page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    await operator.page.mouse.down()
    await operator.page.mouse.move(box["x"] + 0.5 * box["width"], middle, steps=5)
    await operator.page.mouse.up()
    await operator.until("document.querySelector('#plots-all').hidden", False)
    await operator.page.mouse.move(box["x"] + 0.5 * box["width"], middle)
    await operator.until(
        "/ (3[4-9]|40)\\.1 mm/.test(document.querySelector('#plot-jump').closest('figure').textContent)", True
    )
    operator.rig.main.send("track", track(101.0, 0.2))  # what is new does not end it
    await operator.page.wait_for_timeout(600)
    await operator.until("document.querySelector('#plots-all').hidden", False)
    await over.dblclick()
    await operator.until("document.querySelector('#plots-all').hidden", True)


async def test_no_path_is_drawn_over_a_time_of_which_nothing_is_known(operator: Operator) -> None:
    begun = "window.drawn.texts.length === 77 ? window.drawn.begun : 0"
    await operator.page.locator("#fit").click()
    await operator.until("document.querySelector('#pose-xy').textContent.endsWith(' m')", True)
    await operator.until("window.drawn.texts.length", 77)
    without = await operator.page.evaluate(begun)
    for t_s in (0.0, 1.0, 2.0, 3.0, 20.0, 21.0):
        operator.rig.main.send("track", track(t_s, 0.05 * min(t_s, 4.0) - 0.1 + 0.001 * t_s))
    await operator.until(begun, without + 2)
    await operator.page.reload()
    await operator.page.locator("#fit").click()
    await operator.until(begun, without + 2)


async def test_the_page_thins_its_rows_as_the_server_does(operator: Operator) -> None:
    grown, rows = Growing(50, 3.0), list[list[float | None]]()
    for k in range(400):
        t_s = k + 10.0 * (k > 20) + 100.0 * (k > 300)
        grown.add(t_s, float(k * 7 % 13), None)
        rows += [list(row) for row in grown.take_new()]
    script = """async (rows) => {
        const {Rows} = await import("/static/history.js");
        const kept = new Rows(50);
        for (const row of rows) kept.receive([row], false);
        return kept.rows;
    }"""
    assert await operator.page.evaluate(script, rows) == [list(row) for row in grown.rows]


async def test_the_ellipse_has_one_named_scale_until_another_is_chosen(operator: Operator) -> None:
    legend = "document.querySelector('#legend').textContent.includes('3\u03c3 ellipse \u00d7 {}')"
    for scale in (100, 1000, 1, 100):
        await operator.until(legend.format(scale), True)
        for _ in range(3):
            await operator.page.locator("#zoom-in").click()
        await operator.page.locator("#fit").click()
        await operator.until(legend.format(scale), True)
        await operator.page.locator("#ellipse").click()


async def test_messages_are_in_the_order_of_time_and_omissions_are_reported(operator: Operator) -> None:
    word = iter(f"message {chr(97 + k // 26)}{chr(97 + k % 26)}" for k in range(250))
    lines = [
        {
            "event": "operator_message",
            "level": "info",
            "timestamp": f"2026-11-26T03:{k // 60:02}:{k % 60:02}.5Z",
            "text": text,
        }
        for k, text in enumerate(word)
    ]
    (operator.folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    await operator.until(
        "document.querySelector('.left-out')?.textContent", "50 older messages are not shown: see log.jsonl"
    )
    times = await operator.page.evaluate("[...document.querySelectorAll('#log time')].map(time => time.textContent)")
    assert times == [f"11-26 03:{k // 60:02}:{k % 60:02}Z" for k in range(249, 49, -1)]


async def test_an_emergency_is_reported_and_cleared_after_a_confirmation(operator: Operator) -> None:
    page = operator.page
    await operator.until("document.querySelector('#emergency').disabled", False)
    await page.locator("#emergency").click()
    await expect(page.locator("#raise-confirm")).to_be_disabled()  # nothing is chosen beforehand
    await page.locator("#raise button[value='']").click()
    await page.locator("#emergency").click()
    await page.get_by_label(re.compile("^ ?fire")).check()
    await page.locator("#note").fill("smoke")
    await page.locator("#raise-confirm").click()
    await operator.until_text("#answer", "emergency fire: done")
    assert [(one["cmd"], one["kind"], one["note"]) for one in operator.rig.asked] == [("emergency", "fire", "smoke")]
    latched = {"active": [{"kind": "fire", "id": "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11", "note": "smoke"}]}
    (operator.folder / "emergencies.json").write_bytes(msgspec.json.encode(latched))
    await operator.until("document.querySelector('#emergencies strong')?.textContent", "fire: smoke")
    await expect(page.locator("#emergencies button")).to_have_count(0)  # the robot drives home
    operator.status = held("held", "observatory", "clear", EMERGENCY.cause(kind="fire"), "clear", "stop")
    await page.wait_for_timeout(200)
    await operator.until("document.querySelectorAll('#emergencies button').length", 1)
    await page.locator("#emergencies button").click()
    await page.locator("#clear button[value='']").click()
    # With its alarm it is one entry.
    operator.status = {**operator.status, "alarms": [alarm("emergency", "return")]}
    await operator.until("document.querySelectorAll('#emergencies li').length", 0)
    await operator.until("document.querySelectorAll('#alarms li').length", 1)
    await operator.until_text("#alarms .emergency", "fire: smoke Clear …")
    await page.locator("#alarms .emergency button").click()
    await page.locator("#clear-confirm").click()
    await operator.until_text("#answer", "clear: done")
    assert operator.rig.asked[1:] == [{"cmd": "clear", "id": latched["active"][0]["id"]}]
