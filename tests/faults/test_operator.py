"""Operator and observatory: aborts in every state, by whatever way they come, and a robot that nobody looks after."""

import itertools
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil, inf, log
from pathlib import Path
from statistics import median

import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from ccatp.conditions import text_of
from ccatp.conditions.danger import GRIP_TOO_LITTLE
from ccatp.config.models import Config
from ccatp.core import Cause, DeckPose, EmergencyKind, EventCode, Severity, Verdict
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand
from ccatp.links.channels import format_ok
from ccatp.links.robot_messages import Sensors
from ccatp.links.rpc import REPEAT_S, RequestFailed, request
from ccatp.mirror.mirror import Mirror
from ccatp.safety.emergency_latch import EmergencyLatch, cause_of
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.budget import home_time_s
from ccatp.survey.checks import FaultAction, UnattendedFaultTimer
from ccatp.survey.events import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    RETURNING,
    TURNING,
    Abort,
    EmergencyKnown,
    Fault,
    Mode,
    Pause,
    Resume,
)
from ccatp.survey.planning.route import RoutePlanner
from ccatp.survey.planning.search import path_time
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.mission_story import DT, FREE, FRONT_OFF, Story, from_first_leg
from tests.support.scenario import config_of, mirror_of, one_panel
from tests.support.sim_survey import FULL, MeasuredSurvey, plan_of

TABLE_ROWS = [(kind, held) for kind in EmergencyKind for held in (False, True)]
NOBODY_RESUMES = "emergency: earthquake: nothing moves until that is cleared"


@pytest.fixture(scope="module")
def config(config: Config) -> Config:
    return from_first_leg(config)


@pytest.fixture
def story(config: Config, mirror: Mirror) -> Story:
    return Story(config, mirror)


class Aborted(MeasuredSurvey):
    """An emergency in a given state of the mission, and how long it took until the wheels were commanded to stand."""

    def __init__(self, cfg: Config, folder: Path, state: Mode, kind: str, clear_after_s: float = inf) -> None:
        super().__init__(cfg, folder)
        self._at, self._kind, self._clear_after_s = state, kind, clear_after_s
        self.raised_s = self.zero_s = self.cleared_s = inf
        self.moved_while_held = self.was_permitted = False

    def look(self, frame: Sensors) -> None:
        if self.raised_s == inf and self.mission.state.points.done and self.mission.state.mode is self._at:
            self.raised_s = frame.t
            assert self.monitor.emergency(self._kind, "e") is None
        if self.cleared_s == inf and frame.t - self.raised_s >= self._clear_after_s:
            self.cleared_s = frame.t
            assert self.monitor.clear("e", at_base_or_held=self.mission.state.mode is HELD) is None

    def _drive(self, drive: DriveCommand) -> None:
        super()._drive(drive)
        frame = self.robot.delivered
        assert frame is not None
        if self.raised_s <= frame.t and drive == STILL:
            self.zero_s = min(self.zero_s, frame.t)
        if self.raised_s <= frame.t < self.cleared_s:
            verdict = self.monitor.verdict
            self.was_permitted |= verdict.forward or verdict.reverse or verdict.turn
        if self.zero_s < frame.t < self.cleared_s:
            self.moved_while_held |= drive != STILL


# -- O1: aborts -------------------------------------------------------------------------------------------------------


@pytest.mark.fault("O1")
@pytest.mark.parametrize("state", [DRIVING, TURNING, Mode.MEASURING])
def test_a_fire_stops_the_wheels_and_leads_home(state: Mode, tmp_path: Path, measured: Measured) -> None:
    run = Aborted(one_panel(run__seed=3), tmp_path, state, "fire")
    result = run.run()
    measured("O1", 1e3 * (run.zero_s - run.raised_s))
    assert run.zero_s - run.raised_s <= 0.1
    assert (result.outcome, result.cause) == ("aborted, at base", "emergency: fire")
    assert run.fans == []
    left_out = run.mission.survey.left_out(run.mission.state)
    assert len(left_out) + len(run.mission.state.points.done) == 9
    assert set(left_out.values()) == {"emergency: fire"}


@pytest.mark.fault("O1")
@pytest.mark.parametrize("state", [DRIVING, slow_case(TURNING)])
def test_an_earthquake_presses_on_holds_and_leads_home_when_it_is_over(
    state: Mode, tmp_path: Path, measured: Measured
) -> None:
    run = Aborted(one_panel(run__seed=3, run__mirror="fyst-m2"), tmp_path, state, "earthquake", clear_after_s=5.0)
    result = run.run()
    measured("O1", 1e3 * (run.zero_s - run.raised_s))
    assert run.zero_s - run.raised_s <= 0.1
    assert [duty for _, duty in run.fans] == [FULL]
    assert run.fans[0][0] == pytest.approx(run.raised_s + run.robot.frame_s)  # in the next frame
    assert run.cleared_s < inf
    assert not run.moved_while_held
    assert not run.was_permitted  # danger holds it, too
    assert result.outcome == "aborted, at base"
    assert result.summary["danger"]["falls"] == 0
    after = [m for m in run.asked if m.t_s > run.cleared_s]
    assert [m.point for m in after] == [None]  # where it stands is not known any more, and only that is asked


def emergency(raised: int, kind: str = "fire", *, code: EventCode = EventCode.ABORTED) -> Verdict:
    is_shaking = kind == "earthquake"
    verdict = replace(FREE, code=code, cause=cause_of(EmergencyKind(kind)), signal=f"emergency:{kind}", raised=raised)
    free = not is_shaking or code is EventCode.NEAR_EDGE
    return replace(verdict, is_shaking=is_shaking, forward=free, reverse=free, turn=free)


def frames(story: Story, *verdicts: Verdict, count: int = 1) -> Mode:
    """The state after these verdicts, ``count`` times."""
    for verdict in verdicts * count:
        story.frame(verdict)
    return story.state.mode


@pytest.mark.fault("O1")
def test_during_an_earthquake_resume_is_refused(story: Story) -> None:
    story.until_state(DRIVING)
    story.frame(emergency(1, "earthquake"))
    assert story.state.is_paused
    assert story.mission.handle(Resume()) == NOBODY_RESUMES
    assert story.mission.handle(Abort(Cause("operator"))) is None
    assert story.state.mode is HELD
    story.until_state(DONE)  # it is over
    assert story.state.points.done == ()


@pytest.mark.fault("O1", "O3")
def test_an_emergency_that_is_new_outranks_a_pause_and_its_level_does_not(story: Story) -> None:
    story.until_state(DRIVING)
    assert frames(story, emergency(1)) is RETURNING
    assert story.mission.handle(Pause(Cause("operator"))) is None
    # The level; then one of two is cleared: what is left is the older one. Last all are cleared.
    assert frames(story, emergency(1), emergency(1, "power"), count=50) is HELD
    assert frames(story, FREE) is HELD
    assert frames(story, emergency(2)) is RETURNING  # the same kind once more


@pytest.mark.fault("O1", "O2")
def test_an_earthquake_at_an_edge_presses_the_robot_on_and_resume_is_refused(story: Story) -> None:
    story.until_state(DRIVING)
    shaking = emergency(1, "earthquake", code=EventCode.NEAR_EDGE)
    assert frames(story, replace(shaking, off=(True, False, False, False), forward=False)) is BACKING_OFF
    assert story.state.full_fans
    assert story.mission.handle(Pause(Cause("operator"))) is None
    assert story.mission.handle(Resume()) == NOBODY_RESUMES
    assert frames(story, emergency(1, "earthquake")) is HELD
    assert text_of(story.state.cause) == "emergency: earthquake"


@pytest.mark.fault("O1")
def test_what_breaks_in_an_earthquake_waits_for_an_operator_when_it_is_over(story: Story) -> None:
    story.until_state(DRIVING)
    shaking = emergency(1, "earthquake")
    frames(story, shaking, replace(shaking, severity=Severity.FAULT, cause=GRIP_TOO_LITTLE.cause(), signal="grip"))
    assert story.state.is_faulted
    assert frames(story, FREE, count=50) is HELD
    assert story.state.cause == GRIP_TOO_LITTLE.cause()
    assert story.mission.handle(Resume()) is None
    story.until_state(DONE)
    assert story.state.points.done == ()


@pytest.mark.fault("O1")
def test_after_a_restart_with_nothing_latched_the_first_emergency_is_new(story: Story) -> None:
    """It was on its way home by the operator's abort, and paused, when its predecessor died."""
    story.mission.handle(Abort(Cause("operator")))
    story.mission.handle(Pause(Cause("operator")))
    story.mission.handle(EmergencyKnown())
    assert frames(story, FREE) is HELD
    assert frames(story, emergency(1)) is RETURNING


@pytest.mark.fault("O1", "O7")
def test_what_was_latched_before_the_start_is_waited_for_at_base(story: Story) -> None:
    story.mission.handle(Pause(Cause("restarted")))
    story.mission.handle(EmergencyKnown())
    assert frames(story, emergency(4), count=50) is HELD
    assert story.mission.handle(Resume()) == "an emergency of before is latched: 'ccatp clear' it first"
    story.frame()
    assert story.mission.handle(Resume()) is None
    story.until_state(DRIVING)
    assert frames(story, emergency(5)) is RETURNING


@pytest.mark.fault("O1")
def test_the_way_home_is_planned_before_the_robot_misses_it(measured: Measured) -> None:
    longest_s = 0.0
    for name in ("fyst-m1", "fyst-m2"):
        cfg, mirror = config_of(name), mirror_of(name)
        for panel in list(mirror.panels)[::6]:
            x, y = mirror.point_on_deck(mirror.point_ids(panel)[0])
            tries = []
            for _ in range(2):
                begun_s = time.process_time()
                RoutePlanner(mirror, cfg).home(DeckPose(x, y, 1.0))
                tries.append(time.process_time() - begun_s)
            longest_s = max(longest_s, min(tries))
    assert longest_s <= 0.2


# -- O2, O3: back-off, repetition -------------------------------------------------------------------------------------


@pytest.mark.fault("O2")
@pytest.mark.parametrize("count", [0, 1, 10, 40, 80])
def test_an_abort_during_a_back_off_never_drives_forward_and_is_home_bound_soon(
    count: int, story: Story, measured: Measured
) -> None:
    story.until(lambda: story.state.mode is DRIVING and story.v > 0.09)
    frames(story, FRONT_OFF, count=1 + count)
    story.mission.handle(Abort(Cause("fire")))
    begun_s, first = story.t, len(story.orders)
    frames(story, FRONT_OFF, count=20)
    story.until_state(RETURNING)
    measured("O2", story.t - begun_s)
    assert story.t - begun_s <= 2.0
    assert all(order.twist.v_m_s <= 0.0 for order in story.orders[first:])
    story.until_state(DONE)
    assert story.state.points.done == ()


def drive(config: Config, mirror: Mirror, aborts: list[int]) -> list[MissionCommand]:
    """A mission aborted in these frames, to its end."""
    story = Story(config, mirror)
    for k in range(900):
        if k in aborts:
            story.mission.handle(Abort(Cause("fire")))
        story.frame()
    return story.orders


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(61, 400), max_size=6))
@pytest.mark.fault("O3")
def test_repeated_aborts_change_nothing(config: Config, mirror: Mirror, again: list[int]) -> None:
    assert drive(config, mirror, [60, *again]) == drive(config, mirror, [60])


@pytest.mark.fault("O3")
def test_an_abort_in_every_frame_is_one_abort(config: Config, mirror: Mirror, measured: Measured) -> None:
    once, always = drive(config, mirror, [60]), drive(config, mirror, list(range(60, 900)))
    measured("O3", sum(a != b for a, b in zip(once, always, strict=True)))
    assert drive(config, mirror, []) != once


@pytest.mark.fault("O3")
@given(st.lists(st.tuples(st.sampled_from(["a", "b"]), st.sampled_from(["raise", "clear"])), max_size=12))
def test_an_id_counts_once(events: list[tuple[str, str]]) -> None:
    latch = EmergencyLatch()
    raised, cleared = set(), set()
    for name, what in events:
        if what == "raise":
            assert latch.raise_emergency("fire", name) is None
            raised.add(name)
        elif latch.clear(name, at_base_or_held=True) is None:
            cleared.add(name)
        assert latch.is_latched is bool(raised - cleared)


# -- O4: lost messages ------------------------------------------------------------------------------------------------


class Relay:
    """Carries requests to a desk that answers each, and loses messages of both ways."""

    def __init__(self) -> None:
        self.is_lost: Callable[[], bool] = lambda: False
        self.heard: list[bytes] = []
        self.stopping = threading.Event()
        self.endpoint = ""

    def run(self, bound: threading.Event) -> None:
        with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            self.endpoint = f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"
            bound.set()
            while not self.stopping.is_set():
                if not socket.poll(5):
                    continue
                *envelope, payload = socket.recv_multipart()
                if self.is_lost():
                    continue
                self.heard.append(payload)
                if not self.is_lost():
                    socket.send_multipart([*envelope, format_ok()])


@pytest.fixture
def relay() -> Iterator[Relay]:
    with relaying(Relay()) as found:
        yield found


@contextmanager
def relaying(relay: Relay) -> Iterator[Relay]:
    bound = threading.Event()
    thread = threading.Thread(target=relay.run, args=(bound,))
    thread.start()
    assert bound.wait(10.0)
    yield relay
    relay.stopping.set()
    thread.join()


@pytest.mark.fault("O4")
def test_an_emergency_is_sent_until_it_is_received(relay: Relay, measured: Measured) -> None:
    rng, lost = random.Random(3), list[bool]()

    def half_of_them() -> bool:
        lost.append(rng.random() < 0.5)
        return lost[-1]

    relay.is_lost = half_of_them
    for k in range(12):
        assert request(relay.endpoint, b"%d" % k, 10.0, repeats=True)["ok"]
    repeats = [relay.heard.count(b"%d" % k) for k in range(12)]
    assert sum(lost) > 10
    assert min(repeats) >= 1
    assert max(repeats) > 1  # an answer was lost, and asked for again
    # After so many periods fewer than one in 10,000 have been lost each time.
    delivered_s = REPEAT_S * ceil(log(1e-4) / log(0.5))
    measured("O4", delivered_s, "s")
    assert delivered_s <= 1.0


@pytest.mark.fault("O4")
def test_an_emergency_is_acknowledged_at_once(relay: Relay, measured: Measured) -> None:
    took_ms = []
    for _ in range(9):
        begun_s = time.monotonic()
        assert request(relay.endpoint, b"fire", 5.0, repeats=True)["ok"]
        took_ms.append(1e3 * (time.monotonic() - begun_s))
    measured("O4", median(took_ms), "ms")  # of what the machine had to do besides, nothing is said


@pytest.mark.fault("O4")
def test_what_must_not_be_asked_twice_is_asked_once(relay: Relay) -> None:
    assert request(relay.endpoint, b"resume", 5.0)["ok"]
    relay.is_lost = lambda: True
    with pytest.raises(RequestFailed, match=r"no answer from .* within 0\.3 s"):
        request(relay.endpoint, b"resume", 0.3)
    assert relay.heard == [b"resume"]


# -- O7: clear --------------------------------------------------------------------------------------------------------


@pytest.mark.fault("O7")
@pytest.mark.parametrize(("kind", "held"), TABLE_ROWS)
def test_a_clear_is_refused_with_a_reason_while_the_robot_moves(
    kind: EmergencyKind, held: bool, measured: Measured
) -> None:
    latch = EmergencyLatch()
    latch.raise_emergency(kind.value, "a")
    refusal = latch.clear("a", at_base_or_held=held)
    assert latch.is_latched is not held
    assert refusal == (None if held else "the robot is neither at base nor held")
    measured("O7", 100.0)


# -- O8: nobody there -------------------------------------------------------------------------------------------------


@pytest.mark.fault("O8", "F6")
@pytest.mark.parametrize("home_s", [30.0, 120.0, 400.0])
def test_a_fault_on_the_overhang_reminds_every_minute_and_goes_home_in_time(
    home_s: float, story: Story, config: Config, measured: Measured
) -> None:
    cfg = config.health
    story.until_state(DRIVING)
    story.mission.handle(Fault(Cause("leg overdue")))
    vigil = UnattendedFaultTimer(config, falls=True)
    reminders: list[float] = []
    soc, drain = 0.5, 1.0 / cfg.battery_life_s
    while story.state.is_faulted:
        story.frame()
        soc -= 50.0 * DT * drain
        t_s = 50.0 * story.t
        call = vigil.watch(t_s, soc, home_s)
        if call is FaultAction.REMIND:
            reminders.append(t_s)
        elif call is FaultAction.RETURN:
            story.mission.handle(Abort(Cause("nobody came")))
    at_dock = soc - home_s * drain
    measured("O8", (soc - cfg.battery_reserve) / (home_s * drain))
    measured("F6", 100.0 * at_dock)
    assert story.state.mode is RETURNING
    assert at_dock >= cfg.battery_reserve
    assert (soc - cfg.battery_reserve) / (home_s * drain) >= 1.5
    assert len(reminders) >= 20
    assert all(b - a == pytest.approx(60.0, abs=1.0) for a, b in itertools.pairwise(reminders))


@pytest.mark.fault("O8")
@pytest.mark.parametrize(
    ("falls", "soc", "home_s", "times", "calls"),
    [
        # Who does not know where it is stays and reminds.
        (True, 0.01, None, range(200), {60: FaultAction.REMIND, 120: FaultAction.REMIND, 180: FaultAction.REMIND}),
        # A return is tried once, and only where the robot would fall.
        (True, 0.1, 30.0, (0, 1, 61), {0: FaultAction.RETURN, 61: FaultAction.REMIND}),
        (False, 0.0, 30.0, range(50), {}),
    ],
)
def test_reminders_and_one_return(
    falls: bool, soc: float, home_s: float | None, times: range, calls: dict[int, FaultAction], config: Config
) -> None:
    vigil = UnattendedFaultTimer(config, falls=falls)
    found = {t: vigil.watch(float(t), soc, home_s) for t in times}
    assert {t: call for t, call in found.items() if call is not FaultAction.NOTHING} == calls
    vigil.over()
    assert vigil.held_s(300.0) == 0.0
    assert vigil.watch(300.0, 0.1, home_s) is FaultAction.NOTHING


# -- O9: the way home -------------------------------------------------------------------------------------------------


@pytest.mark.fault("O9")
@pytest.mark.parametrize(
    ("step", "expected"), [(9, 87 + 78), pytest.param(1, 1485, marks=pytest.mark.slow, id="every point")]
)
def test_the_way_home_stays_on_the_mirror_and_takes_no_longer_than_thought(
    step: int, expected: int, measured: Measured
) -> None:
    """From every ``step``-th point of both mirrors of the thesis."""
    count = invalid = 0
    rng = random.Random(9)
    for name in ("thesis-m1", "thesis-m2"):
        cfg, mirror = config_of(name), mirror_of(name)
        base, least_m = mirror.base_pose, cfg.mission.leg_clearance_m - 1e-9
        points = [point for panel in mirror.panels for point in mirror.point_ids(panel)]
        for point in points[::step]:
            count += 1
            x, y = mirror.point_on_deck(point)
            start = DeckPose(x, y, rng.uniform(-3.14, 3.14))
            stops = RoutePlanner(mirror, cfg).home(start, base)
            ends = [(stop.x_m, stop.y_m) for stop in stops]
            # The first leg may begin nearer to the rim than legs keep to it, but leads away from it.
            own_m = min(least_m, mirror.rim.signed_distance_m(x, y) - 1e-9)
            clear_m = [mirror.rim.segment_clearance_m(*a, *b) for a, b in itertools.pairwise([(x, y), *ends])]
            is_valid = clear_m[0] >= own_m and all(c >= least_m for c in clear_m[1:])
            takes_s = path_time(stops, start, cfg.limits, mirror, 0.0)
            invalid += not (is_valid and takes_s <= home_time_s(mirror, cfg.limits, x, y))
    measured("O9", invalid)
    assert (count, invalid) == (expected, 0)


# -- O10: the budget --------------------------------------------------------------------------------------------------


@pytest.mark.fault("O10")
@pytest.mark.parametrize("budget_s", [pytest.param(45.0, marks=pytest.mark.slow), 70.0])
def test_points_beyond_the_budget_are_not_measured(budget_s: float, tmp_path: Path, measured: Measured) -> None:
    cfg = one_panel(run__seed=3, run__panels=2, run__budget_s=budget_s, mission__holds_to_budget=True)
    run = MeasuredSurvey(cfg, tmp_path, plan=plan_of("body slip at_s=20.0 for_s=20.0 factor=0.8"))
    result = run.run()
    points = result.summary["points"]
    # The same share of an hour.
    measured("O10", 3600.0 * result.mission_time_s / budget_s)
    assert result.mission_time_s <= budget_s
    assert result.outcome in {"complete", "aborted, at base"}
    assert 0 < points["measured"] < 18
    assert len(run.mission.survey.left_out(run.mission.state)) == 18 - points["measured"]
    assert set(run.mission.survey.left_out(run.mission.state).values()) <= {
        "no time for it",
        f"the time budget of {budget_s:g} s is used up",
    }


@pytest.mark.fault("O10")
def test_a_budget_that_suffices_changes_nothing(tmp_path: Path) -> None:
    found = []
    for holds in (True, False):
        folder = tmp_path / str(holds)
        folder.mkdir()
        found.append(MeasuredSurvey(one_panel(run__seed=3, mission__holds_to_budget=holds), folder).run())
    assert found[0].summary == found[1].summary
    assert found[0].outcome == "complete"
