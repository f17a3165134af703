"""Faults behind the robot link: lockstep waits for no frame that nobody can answer, a reboot ends every session."""

import json
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.fault_plan import parse_plan
from ccatp.sim.robot import Robot
from ccatp.sim.sessions import NO_DELIVERY_S, RobotServer, RobotSession


class Wire:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent = b""
        self.is_closed = False

    def write(self, data: bytes) -> None:
        self.sent += data

    def close(self) -> None:
        self.is_closed = True


class Rig:
    """A server with one controller that answers every frame it can take."""

    def __init__(self, config: Config, mirror: Mirror, plan: str, *, lockstep: bool = True) -> None:
        self.now_s, self.notes = 100.0, list[str]()
        self.robot = Robot(config, mirror, np.random.default_rng(1), parse_plan(plan, "plan"))
        self.server = RobotServer(
            self.robot,
            lockstep=lockstep,
            boot=417,
            key=None,
            make_nonce=lambda: "ab" * 16,
            now_s=self.now_s,
            note=self.notes.append,
            on_frame=lambda: None,
        )

    def join(self, role: str = "controller") -> tuple[RobotSession, Wire]:
        wire = Wire()
        session = self.server.accept(wire, self.now_s)
        session.receive(json.dumps({"type": "join", "role": role, "client": "test"}).encode() + b"\n", self.now_s)
        return session, wire

    def answer(self, session: RobotSession, wire: Wire, number: int) -> list[dict[str, Any]]:
        """What came since the last answer; the newest frame in it is answered."""
        lines, wire.sent = wire.sent.splitlines(), b""
        messages = [json.loads(line) for line in lines]
        ack = self.robot.delivered_seq
        session.receive(b'{"type":"drive","seq":%d,"ack":%d,"wr":1.0,"wl":1.0}\n' % (number, ack), self.now_s)
        return messages


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


def frames(messages: list[dict[str, Any]]) -> list[int]:
    return [message["seq"] for message in messages if message["type"] == "sensors"]


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
def test_lockstep_goes_on_past_frames_that_nobody_can_answer(
    config: Config, mirror: Mirror, plan: str, expected: list[int]
) -> None:
    rig = Rig(config, mirror, f"[[fault]]\nat_s = 0.05\nfor_s = 0.03\n{plan}")
    session, wire = rig.join()
    seen, answers = list[int](), 0
    while not seen or seen[-1] < 9:
        answers += 1
        seen += frames(rig.answer(session, wire, answers))
    assert seen == [0, *expected]
    if "drop" in plan or "non_finite" in plan or "soc" in plan:
        assert rig.robot.world.plant.forward_m > 0.0
        assert answers == 10 - 3  # three frames were not answered by anybody


def test_a_robot_that_is_never_heard_again_ends_the_session(config: Config, mirror: Mirror) -> None:
    rig = Rig(config, mirror, '[[fault]]\nsignal = "frames"\ntype = "drop"\nat_s = 0.05\nevery = 1')
    session, wire = rig.join()
    for number in range(1, 7):
        rig.answer(session, wire, number)
    assert wire.is_closed
    assert f"controller dropped: no frame could be delivered for {NO_DELIVERY_S:g} s" in rig.notes
    assert rig.robot.t_s == pytest.approx(NO_DELIVERY_S, abs=0.2)
    again, second = rig.join()
    assert second.is_closed
    assert not again.is_open


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_reboot_ends_every_session_and_changes_the_boot(config: Config, mirror: Mirror, lockstep: bool) -> None:
    rig = Rig(config, mirror, '[[fault]]\nsignal = "robot"\ntype = "reboot"\nat_s = 0.05', lockstep=lockstep)
    session, wire = rig.join()
    _, monitor = rig.join("monitor")
    visitor = Wire()
    rig.server.accept(visitor, rig.now_s)
    number = 0
    while not wire.is_closed:
        number += 1
        if lockstep:
            permit = b'{"type":"permit","seq":%d,"ack":%d,"forward":true,"reverse":true,"turn":true}\n'
            _, holder = next((r, s) for r, s in rig.server._holders.items() if r == "monitor")
            holder.receive(permit % (number, rig.robot.delivered_seq), rig.now_s)
            rig.answer(session, wire, number)
        else:
            rig.now_s = rig.server.next_frame_s
            rig.server.tick(rig.now_s)
    assert monitor.is_closed
    assert visitor.is_closed
    assert rig.robot.reboots == 1
    assert rig.robot.t_s == pytest.approx(0.06)
    assert "controller dropped: the robot rebooted" in rig.notes
    _, again = rig.join()
    hello, joined, *rest = map(json.loads, again.sent.splitlines())
    assert (hello["boot"], joined["type"]) == (418, "joined")
    if lockstep:
        assert rest[0]["seq"] == 1
        assert rest[0]["cmd"]["held"]
