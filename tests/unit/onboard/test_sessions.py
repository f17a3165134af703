"""The robot's side of the link without sockets, in virtual time."""

from collections.abc import Callable

import pytest

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.onboard.sessions import LOCKSTEP_SILENCE_S, MAX_LAG_S, MAX_SESSIONS, NO_DELIVERY_S, SILENCE_S
from ccatp.sim.fault_plan import parse_plan
from tests.support.scenario import ServedRobot, boot, config_of, fault_plan

JOIN = b'{"type":"join","role":"controller","client":"test"}\n'
JOIN_MONITOR = b'{"type":"join","role":"monitor","client":"test"}\n'


Rig = Callable[..., ServedRobot]


@pytest.fixture
def rig(config: Config, mirror: Mirror) -> Rig:
    return lambda **options: ServedRobot(config, mirror, **options)


# -- joining ----------------------------------------------------------------------------------------------------------


def test_garbage_before_the_join_is_dropped_and_the_join_still_counts(rig: Rig) -> None:
    r = rig(lockstep=False)
    client = r.client(b'garbage\n{"type":"wave"}\n' + JOIN)
    assert client.kinds == ["hello", "joined"]
    assert (r.server.counts["bad_lines"], r.server.counts["unknown_types"]) == (1, 1)


def test_too_many_connections(rig: Rig) -> None:
    r = rig()
    clients = [r.client() for _ in range(MAX_SESSIONS)]
    assert r.client().messages[-1] == {"type": "refused", "reason": "busy"}
    r.server.lost(clients[0])
    assert r.client(JOIN).kinds == ["hello", "joined", "0"]


def test_in_lockstep_the_silence_after_which_a_role_is_free_is_in_wall_time(rig: Rig) -> None:
    r = rig()
    holder = r.client(JOIN)
    holder.drive(0, 0)
    for number in range(1, 10):  # an answer that is held back
        r.now_s += 0.9 * SILENCE_S
        holder.drive(number, 0)
        assert r.client(JOIN).messages[-1] == {"type": "refused", "reason": "role taken"}
    assert r.robot.seq == 1
    r.now_s += 1.1 * SILENCE_S
    assert r.client(JOIN).kinds == ["hello", "joined", "1"]
    assert holder.is_closed


NO_MESSAGE = {
    "not valid": b'{"type":"drive","seq":9\n',
    "unknown type": b'{"type":"wave","seq":9}\n',
    "of the other role": b'{"type":"permit","seq":9,"ack":0,"forward":true,"reverse":true,"turn":true}\n',
}


@pytest.mark.parametrize("line", NO_MESSAGE.values(), ids=NO_MESSAGE)
def test_a_line_that_is_no_message_of_its_role_does_not_keep_the_role(rig: Rig, line: bytes) -> None:
    r = rig()
    holder = r.client(JOIN)
    holder.drive(0, 0)
    for _ in range(4):
        r.now_s += 0.25 * SILENCE_S
        holder.send(line)
        assert r.client(JOIN).messages[-1] == {"type": "refused", "reason": "role taken"}
    r.now_s += 0.01
    assert r.client(JOIN).kinds == ["hello", "joined", "1"]


# -- lockstep ---------------------------------------------------------------------------------------------------------


def test_a_lost_monitor_stops_simulated_time_until_another_joins(rig: Rig) -> None:
    r = rig()
    controller, monitor = r.client(JOIN), r.client(JOIN_MONITOR)
    monitor.permit(0, 0)
    controller.drive(0, 0)
    r.server.lost(monitor)
    controller.drive(1, 1)
    assert r.robot.seq == 1
    half = r.client(JOIN_MONITOR)
    r.server.lost(controller)
    half.permit(0, 1)
    r.server.lost(half)  # its answer goes with it
    controller = r.client(JOIN)
    controller.drive(0, 1)
    assert r.robot.seq == 1
    again = r.client(JOIN_MONITOR)
    assert again.kinds == ["hello", "joined", "1"]
    again.permit(0, 1)
    assert r.robot.seq == 2
    assert not r.robot.rules.is_held


def test_a_stall_is_noted_once_per_frame_and_waited_for(rig: Rig) -> None:
    r = rig()
    monitor = r.client(JOIN_MONITOR)
    r.server.check_time(r.now_s + 100.0)
    controller = r.client(JOIN)
    for late_s in (4.9, 5.1, 7.0):
        r.server.check_time(r.now_s + late_s)
    stalls = [note for note in r.notes if "stall" in note]
    assert stalls == ["stall: frame 0 waits for its drive"]
    r.now_s += 10.0
    controller.drive(0, 0)
    r.server.check_time(r.now_s)
    assert [note for note in r.notes if "stall" in note] == stalls
    monitor.permit(0, 0)
    controller.drive(1, 1)
    r.server.check_time(r.now_s + 6.0)
    assert r.notes[-1] == "stall: frame 1 waits for its permit"


def test_a_client_without_a_line_for_a_minute_loses_its_session(rig: Rig) -> None:
    r = rig()
    monitor, controller = r.client(JOIN_MONITOR), r.client(JOIN)
    controller.drive(0, 0)
    for number in range(1, 13):
        r.now_s += 5.0
        controller.drive(number, 0)
        r.server.check_time(r.now_s)
        assert not monitor.is_closed
    r.now_s += 1.0
    r.server.check_time(r.now_s)
    assert monitor.is_closed
    assert not controller.is_closed
    assert "monitor dropped: no line for 60 s" in r.notes
    r.now_s += LOCKSTEP_SILENCE_S + 1.0
    r.server.check_time(r.now_s)
    assert controller.is_closed
    assert r.robot.seq == 0


def test_a_monitor_that_waits_for_a_controller_keeps_its_session(rig: Rig) -> None:
    r = rig()
    monitor = r.client(JOIN_MONITOR)
    r.now_s += 3600.0
    r.server.check_time(r.now_s)
    controller = r.client(JOIN)
    r.server.check_time(r.now_s + 1.0)
    assert not monitor.is_closed
    assert monitor.kinds == controller.kinds == ["hello", "joined", "0", "0"]


# -- realtime ---------------------------------------------------------------------------------------------------------


def test_late_frames_are_made_up_for(rig: Rig) -> None:
    r = rig(lockstep=False)
    r.run(0.1)
    r.now_s += 0.1  # nobody called for ten periods
    late = 0
    while r.server.next_frame_s <= r.now_s:
        r.server.tick(r.now_s)
        late += 1
    assert late in (9, 10)
    assert r.server.counts["slips"] in (8, 9)
    assert r.server.next_frame_s == pytest.approx(1000.0 + (r.robot.seq + 1) * 0.01, abs=1e-9)


def test_a_drive_read_first_after_a_long_stop_lives_no_longer_than_any_other(rig: Rig) -> None:
    r = rig(lockstep=False)
    controller = r.client(JOIN)
    r.run(0.1)
    r.now_s += 20.0
    controller.drive(1, 10)  # before the frame that is late
    r.run(0.2)
    assert not controller.messages[-1]["cmd"]["held"]
    r.run(0.1)
    assert controller.messages[-1]["cmd"]["held"]
    assert r.server.counts["slips"] == 1


def test_after_a_long_stop_the_clock_continues_where_it_stood(rig: Rig) -> None:
    r = rig(lockstep=False)
    controller = r.client(JOIN)
    r.run(0.1)
    controller.drive(1, 10)
    r.now_s += 20.0
    assert r.now_s - r.server.next_frame_s > MAX_LAG_S
    r.server.tick(r.now_s)
    assert r.server.next_frame_s == pytest.approx(r.now_s + 0.01, abs=1e-6)
    assert r.robot.seq == 11


# -- delays -----------------------------------------------------------------------------------------------------------

LATE = config_of(world__sensors_delay_s=0.02, world__commands_delay_s=0.01)


@pytest.mark.parametrize(("sensors", "commands"), [(1, 0), (0, 1), (1, 1), (2, 2)])
def test_lockstep_with_delays(mirror: Mirror, sensors: int, commands: int) -> None:
    r = ServedRobot(config_of(world__sensors_delay_s=0.01 * sensors, world__commands_delay_s=0.01 * commands), mirror)
    monitor = r.client(JOIN_MONITOR)
    assert (monitor.kinds, r.robot.seq) == (["hello", "joined"], 0)
    controller = r.client(JOIN)
    # The frames before the first delivery ran by themselves.
    assert (controller.kinds, monitor.kinds) == (["hello", "joined", "0"], ["0"])
    assert (r.robot.seq, r.frames, r.robot.rules.is_held) == (sensors, sensors, True)
    first = sensors + commands  # the first step that the drive sent on frame 0 moves
    for k in range(12):
        monitor.permit(k, k)
        assert r.robot.seq == sensors + k
        controller.drive(k, k)
        frame = controller.messages[-1]
        assert (frame["seq"], r.robot.seq) == (k + 1, sensors + k + 1)
        assert r.robot.rules.is_held is (r.robot.seq - 1 < first)
        assert frame["cmd"]["held"] is (frame["seq"] <= first)
        if not frame["cmd"]["held"]:
            assert frame["cmd"]["seq"] == frame["seq"] - 1 - first
            assert frame["cmd"]["age"] == pytest.approx(0.01 * (commands + 1), abs=1e-6)  # in microseconds
            assert frame["cmd"]["permit_age"] == frame["cmd"]["age"]


def test_in_lockstep_the_newest_frame_delivered_is_to_be_acknowledged(mirror: Mirror) -> None:
    r = ServedRobot(LATE, mirror)
    controller = r.client(JOIN)
    controller.drive(0, 2)  # the robot's own newest, which nobody can know
    assert r.robot.seq == 2
    controller.drive(1, 0)
    assert r.robot.seq == 3
    r.server.lost(controller)
    again = r.client(JOIN)
    assert again.kinds == ["hello", "joined", "1"]  # no frame is lost or driven by joining anew
    assert r.robot.seq == 3


def test_delays_on_the_wall_clock(mirror: Mirror) -> None:
    r = ServedRobot(LATE, mirror, lockstep=False)
    controller = r.client(JOIN)
    r.run(0.0101)
    assert controller.kinds == ["hello", "joined"]  # frame 1 exists, frame 0 is on its way
    r.run(0.01)
    assert controller.kinds == ["0"]
    r.run(0.003)
    controller.drive(0, 0)  # arrives 3.1 ms after frame 2
    held = []
    for _ in range(8):
        r.run(0.01)
        held.append(controller.messages[-1])
    # Driven from frame 3 on, so frame 4 is the first that tells; it is delivered 20 ms later.
    assert [(m["seq"], m["cmd"]["held"]) for m in held] == [(k, k < 4) for k in range(1, 9)]
    assert held[3]["cmd"]["age"] == pytest.approx(0.0169, abs=1e-5)


def test_the_server_and_the_calls_give_the_same_frames(mirror: Mirror) -> None:
    cfg = config_of(run__world="hard")
    r = ServedRobot(cfg, mirror)
    monitor, controller = r.client(JOIN_MONITOR), r.client(JOIN)
    controller.send(b'{"type":"fans","seq":0,"duty":[0.8,0.8]}\n')
    for k in range(200):
        monitor.permit(k, k, b"true" if k % 50 < 40 else b"false")
        controller.drive(k, k, 3.0, 2.5)
    robot = boot(cfg, mirror)
    robot.join("monitor")
    robot.join("controller")
    while robot.delivered is None:
        robot.advance()
    lines = [robot.delivered_line]
    robot.command_fans(0, 0.8, 0.8)
    for k in range(200):
        robot.permit(k, *[k % 50 < 40] * 3)
        robot.drive(k, 3.0, 2.5)
        robot.advance()
        lines.append(robot.delivered_line)
    assert controller.sent.splitlines(keepends=True)[2:] == lines


# -- faults: lockstep waits for no frame that nobody can answer, a reboot ends every session ---------------------------


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        ('signal = "frames"\ntype = "drop"\nevery = 1', [1, 2, 3, 4, 8, 9]),
        ('signal = "frames"\ntype = "reorder"\nevery = 2', [1, 2, 3, 4, 5, 7, 6, 8, 9]),
        ('signal = "frames"\ntype = "duplicate"\nevery = 2', [1, 2, 3, 4, 5, 6, 6, 7, 8, 9]),
        ('signal = "imu_wz"\ntype = "non_finite"\ntoken = "NaN"', [1, 2, 3, 4, 5, 6, 7, 8, 9]),
        ('signal = "soc"\ntype = "stuck"\nvalue = 7.0', [1, 2, 3, 4, 5, 6, 7, 8, 9]),
    ],
)
def test_lockstep_continues_past_frames_that_nobody_can_answer(rig: Rig, plan: str, expected: list[int]) -> None:
    r = rig(plan=parse_plan(f"[[fault]]\nat_s = 0.05\nfor_s = 0.03\n{plan}", "plan"))
    controller, seen, answers = r.client(JOIN), list[str](), 0
    controller.messages.clear()
    while not seen or seen[-1] != "9":
        controller.drive(answers, r.robot.delivered_seq)
        answers += 1
        seen += controller.kinds
    assert seen == [str(seq) for seq in expected]
    if "drop" in plan or "non_finite" in plan or "soc" in plan:
        assert r.robot.world.plant.forward_m > 0.0
        assert answers == 9 - 3  # three frames were not answered by anybody


def test_a_robot_that_is_never_received_again_ends_the_session(rig: Rig) -> None:
    r = rig(plan=fault_plan({"signal": "frames", "type": "drop", "at_s": 0.05, "every": 1}))
    controller = r.client(JOIN)
    for number in range(6):
        controller.drive(number, r.robot.delivered_seq)
    assert controller.is_closed
    assert f"controller dropped: no frame could be delivered for {NO_DELIVERY_S:g} s" in r.notes
    assert r.robot.t_s == pytest.approx(NO_DELIVERY_S, abs=0.2)
    assert r.client(JOIN).is_closed


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize("keeps_number", [True, False])
def test_a_reboot_ends_every_session_and_changes_the_boot(rig: Rig, lockstep: bool, keeps_number: bool) -> None:
    reboot = {"signal": "robot", "type": "reboot", "at_s": 0.05, "keeps_number": keeps_number}
    r = rig(plan=fault_plan(reboot), lockstep=lockstep)
    controller, monitor, visitor = r.client(JOIN), r.client(JOIN_MONITOR), r.client()
    boot = visitor.messages[0]["boot"]
    number = 0
    while not controller.is_closed:
        if lockstep:
            monitor.permit(number, r.robot.delivered_seq)
            controller.drive(number, r.robot.delivered_seq)
            number += 1
        else:
            r.run(0.01)
    assert monitor.is_closed
    assert visitor.is_closed
    assert r.robot.reboots == 1
    assert r.robot.t_s == pytest.approx(0.06)
    assert "controller dropped: the robot rebooted" in r.notes
    hello, joined, *rest = r.client(JOIN).messages
    assert (hello["boot"], joined["type"]) == (boot + (not keeps_number), "joined")
    if lockstep:
        assert (rest[0]["seq"], rest[0]["cmd"]["held"]) == (1, True)
