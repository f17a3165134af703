"""A drive off the rim, by a controller that ignores verdicts, is stopped by the real danger loop.

On every side of every mirror, in lockstep and in real time.
"""

import asyncio
import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import product
from math import cos, hypot, pi, sin
from pathlib import Path
from typing import NamedTuple

import pytest
import zmq

from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, PanelId, Twist
from ccatp.daemon.supervision.process import Endpoints
from ccatp.kinematics import twist_of, wheel_rates
from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.robot_link import LinkHandler, RobotLink
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import DangerEvent, EstimateMessage, Heartbeat, TruthMessage
from ccatp.mirror.mirror import build_mirror
from tests.support.scenario import config_of, mirror_of

START_M = 0.20  # of the robot's origin inside the rim: all sensors stand on the mirror, whatever the heading
PATIENCE_S = 60.0
OUTWARD = {"right": 0.0, "top": 0.5 * pi, "left": pi, "bottom": -0.5 * pi}
MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
SPEEDS = (0.02, 0.05, 0.1, 0.15)
QUARTER = 0.25 * pi


class RimCase(NamedTuple):
    """One drive: which side of which mirror, how fast, at what angle to the outward normal."""

    mirror: str
    side: str
    speed_m_s: float
    angle_rad: float
    is_realtime: bool
    is_pose_right: bool = True


# A wrong pose is tried in lockstep only: what it changes is the rule, not the timing.
ALL = [
    RimCase(*drive, *how)
    for drive in product(MIRRORS, OUTWARD, SPEEDS, (0.0, QUARTER))
    for how in ((False, True), (False, False), (True, True))
]
FEW = [
    RimCase("fyst-m2", "top", 0.15, QUARTER, False),
    RimCase("thesis-m1", "left", 0.02, QUARTER, False, is_pose_right=False),
    RimCase("fyst-m1", "bottom", 0.15, QUARTER, True, is_pose_right=False),
]


def configure(case: RimCase) -> Config:
    """The default configuration with the base in front of the rim, in the middle of a side, heading towards it."""
    mirror, outward = mirror_of(case.mirror), OUTWARD[case.side]
    dx, dy = round(cos(outward)), round(sin(outward))
    row, col = (mirror.rows + 1) // 2, (mirror.cols + 1) // 2
    on_side = [p for p in mirror.panels if PanelId(p.row + dy, p.col + dx) not in mirror.panels]
    panel = min(on_side, key=lambda p: (abs(p.row - row) if dx else abs(p.col - col), -dx * p.col - dy * p.row))
    body = mirror.panels[panel]
    x, y = dx * (body.half_x_m - START_M), dy * (body.half_y_m - START_M)
    place = {"row": panel.row, "col": panel.col, "x_mm": 1e3 * x, "y_mm": 1e3 * y}
    cfg = config_of(case.mirror, run__world="thesis", sim__robot__port=0)
    base = cfg.mirror.base.model_copy(update=place | {"heading_rad": outward + case.angle_rad})
    return cfg.model_copy(update={"mirror": cfg.mirror.model_copy(update={"base": base})})


class RecklessMain:
    """Stands in for the main loop: claims a pose, never listens to a verdict."""

    def __init__(self, case: RimCase, cfg: Config, publisher: Publisher) -> None:
        self._robot, self._publisher, self._is_pose_right = cfg.robot, publisher, case.is_pose_right
        self._mirror = build_mirror(cfg.mirror)
        # A wrong pose: it believes itself in the middle of the mirror, with no rim and no seam anywhere near.
        self._pose = self._mirror.base_pose if case.is_pose_right else DeckPose(0.05, 0.05, 0.3)
        self._t_s = 0.0
        self._wheels = wheel_rates(Twist(case.speed_m_s, 0.0), cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m)
        self.held_frames = self.frames = 0

    def presence(self) -> None:
        """Be seen by the danger loop."""
        self._publisher.send("heartbeat.main", Heartbeat(seq=0, t_s=0.0, process="main", pid=0, phase="ready"))

    def on_sensors(self, link: RobotLink, sensors: Sensors) -> None:
        """Dead-reckon, claim the pose, drive on."""
        robot = self._robot
        if not self.frames:
            link.send_fans(1, robot.fan_duty)
        for sample in sensors.enc:
            right, left = sample.right_rad_s, sample.left_rad_s
            if right is None or left is None:
                continue
            twist = twist_of(right, left, robot.wheel_radius_m, robot.wheel_base_m)
            dt = sample.t_s - self._t_s if self._t_s else 0.0
            self._t_s = sample.t_s
            x, y = self._mirror.body_offset(self._pose, twist.v_m_s * dt, 0.0)
            if self._is_pose_right:
                self._pose = DeckPose(x, y, self._pose.heading_rad + twist.omega_rad_s * dt)
        self.frames += 1
        is_moving = any(hypot(s.right_rad_s or 0.0, s.left_rad_s or 0.0) > 0.05 for s in sensors.enc)
        self.held_frames = 0 if is_moving or self.frames < 50 else self.held_frames + 1
        pose = self._pose
        claim = EstimateMessage(
            seq=sensors.seq, t_s=sensors.t, x_m=pose.x_m, y_m=pose.y_m, heading_rad=pose.heading_rad, sigma_m=0.001,
            state="driving",
        )  # fmt: skip
        self._publisher.send("estimate", claim)
        link.send_drive(sensors.seq, sensors.seq, *self._wheels)


@contextlib.contextmanager
def processes(cfg: Config, case: RimCase, run_dir: Path, endpoints: Endpoints) -> Iterator[int]:
    """The real DataLoop and the real danger loop; yields the robot's port."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        fd, port = listener.fileno(), listener.getsockname()[1]
        cfg = cfg.model_copy(update={"robot": cfg.robot.model_copy(update={"port": port})})
        (run_dir / "config.toml").write_text(dump_config(cfg))
        common = ["--run-dir", str(run_dir), "--runtime-dir", str(endpoints.runtime_dir)]
        common += ["--realtime"] if case.is_realtime else []
        python = [sys.executable, "-m"]
        started = [
            subprocess.Popen(
                [*python, "ccatp.daemon.loops.sim_robot", *common, "--listen-fd", str(fd)], pass_fds=(fd,)
            ),
            subprocess.Popen([*python, "ccatp.daemon.loops.danger_loop", *common]),
        ]
        try:
            yield port
        finally:
            for process in reversed(started):
                process.terminate()
            for process in started:
                process.wait(10.0)


async def check(case: RimCase, run_dir: Path, runtime_dir: Path) -> None:
    """Run one case to the robot's standstill, and look at the truth of it."""
    endpoints, cfg = Endpoints(runtime_dir), configure(case)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    sources = [endpoints.of("truth"), endpoints.of("danger")]
    heard = Subscriber(context, sources, ["truth", "danger_event", "heartbeat.danger", "verdict"])
    publisher = Publisher(context, endpoints.of("main"))
    main, deadline = RecklessMain(case, cfg, publisher), time.monotonic() + PATIENCE_S
    try:
        with processes(cfg, case, run_dir, endpoints) as port:
            is_joined = False
            while not is_joined:
                assert time.monotonic() < deadline, "the danger loop never joined"
                main.presence()
                while (received := heard.receive()) is not None:
                    message = received[2]
                    is_joined = is_joined or (isinstance(message, Heartbeat) and message.phase == "joined")
                await asyncio.sleep(0.02)
            link = RobotLink(
                host=cfg.robot.host, port=port, role="controller", client="reckless", key=None,
                handler=LinkHandler(lambda sensors, _raw: main.on_sensors(link, sensors), lambda _reason: None),
            )  # fmt: skip
            await link.connect(5.0)
            clearances: dict[int, float] = {}
            has_fallen, declared_at, is_over = False, None, False
            while not is_over:
                assert time.monotonic() < deadline, f"{case}: still moving"
                await asyncio.sleep(0.005)
                is_over = main.held_frames > 60
                if is_over:
                    flush(context, endpoints)
                    await asyncio.sleep(0.2)  # what is on its way when the robot stands must be heard too
                while (received := heard.receive()) is not None:
                    message = received[2]
                    if isinstance(message, TruthMessage):
                        clearances.update({row[0]: row[8] for row in message.rows})
                        has_fallen = has_fallen or any(row[9] for row in message.rows)
                    elif isinstance(message, DangerEvent) and message.code == 1 and declared_at is None:
                        declared_at = message.seq
            link.close()
    finally:
        publisher.close()
        heard.close()
        context.destroy(linger=0)
    assert not has_fallen
    assert declared_at is not None
    overrun_m = max(0.0, -min(clearances.values()))
    # Invariant I5: at most 20 mm further once the edge is declared.
    assert overrun_m - max(0.0, -clearances.get(declared_at, 0.0)) <= 0.020
    # The centre of mass is 90 mm behind the front sensors: less than half of that may hang over.
    assert overrun_m <= 0.045


def flush(context: zmq.Context[zmq.Socket[bytes]], endpoints: Endpoints) -> None:
    with context.socket(zmq.REQ) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.connect(endpoints.of("puck"))
        peer.send(b"flush")
        assert peer.poll(5000), "the DataLoop does not answer"
        peer.recv()


@pytest.mark.parametrize("case", [*FEW, *(pytest.param(case, marks=pytest.mark.slow) for case in ALL)], ids=str)
async def test_a_drive_off_the_rim_is_stopped(case: RimCase, tmp_path: Path, runtime_dir: Path) -> None:
    await check(case, tmp_path, runtime_dir)
