"""Reads robot, laser system and machine for the preflight checks; nothing moves, nothing changes."""

import asyncio
import ctypes
import logging
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path

import structlog

from ccatp.commissioning.preflight import (
    LASER_NAMES,
    ROBOT_CHECKS,
    PreflightResult,
    RobotReport,
    check_air,
    check_fix,
    check_lasers,
    check_robot,
    check_time,
    failed,
    named,
    passed,
    skipped,
    warned,
)
from ccatp.config.files import read_key
from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.daemon.operator.observatory import check_observatory
from ccatp.daemon.supervision.child_processes import (
    ProcessManager,
    ProcessSpec,
    listen,
    simulated_servers,
    with_addresses,
)
from ccatp.daemon.supervision.supervisor import PROCESSES
from ccatp.errors import CcatpError, ConfigError
from ccatp.etalon_client import EtalonClient, EtalonError, EtalonUnreachable
from ccatp.links.robot_link import ImpossibleRobot, LinkHandler, RobotLink, RobotLinkError
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.runtime_dir import make_runtime_dir
from ccatp.mirror.mirror import Mirror, build_mirror

LISTEN_S = 3.0
FIRST_FRAME_S = 2.0
# A mission of one hour writes a tenth of this to its recording, and the same to its database.
FREE_BYTES = 2_000_000_000
WRITES, SLOW_WRITE_S = 20, 0.1
_TIME_ERROR = 5
_LOCAL = ("127.", "localhost", "::1")


def probe_all(
    cfg: Config, config_file: Path | None, runs_dir: Path, runtime_dir: Path | None, *, sim: bool
) -> list[PreflightResult]:
    """Check everything that a mission needs; with ``sim``, start simulated robot and laser servers and check these.

    Raises ConfigError: the simulated servers cannot listen.
    """
    mirror = build_mirror(cfg.mirror)
    where = config_file or "the default one"
    found = [
        *named(configuration=passed(f"{where}: mirror {mirror.name}, {len(mirror.panels)} panels")),
        *probe_machine(cfg, runs_dir, runtime_dir, os.environ),
        *named(
            time_budget=check_time(cfg, mirror),
            robot_key=probe_key(cfg, sim=sim),
            observatory_keys=_observatory(cfg),
        ),
    ]

    async def probe() -> list[PreflightResult]:
        robot, laser = await asyncio.gather(probe_robot(cfg, mirror), probe_laser(cfg, mirror))
        return [*robot, *laser]

    with ExitStack() as stack:
        # The clients' log lines would be mixed with the result.
        stack.callback(lambda before: structlog.configure(**before), structlog.get_config())
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
        if sim:
            cfg = stack.enter_context(_stand_ins(cfg))
        return [*found, *asyncio.run(probe())]


@contextmanager
def _stand_ins(cfg: Config) -> Iterator[Config]:
    """Start the simulated servers on free ports in real time; yield the configuration with their addresses."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ccatp-")))
        any_port = {part: getattr(cfg.sim, part).model_copy(update={"port": 0}) for part in ("robot", "etalon")}
        cfg = cfg.model_copy(update={"sim": cfg.sim.model_copy(update=any_port)})
        sockets = {
            one.process: stack.enter_context(listen(one.section, one.at.host, one.at.port))
            for one in simulated_servers(cfg)
        }
        cfg = with_addresses(cfg, sockets)
        (folder / "config.toml").write_text(dump_config(cfg), encoding="utf-8")

        def command_of(process: ProcessSpec, _is_restarted: bool) -> tuple[list[str], tuple[int, ...]]:
            fd = sockets[process.name].fileno()
            where = ["--run-dir", str(folder), "--runtime-dir", str(folder)]
            return [*where, "--realtime", "--listen-fd", str(fd)], (fd,)

        children = ProcessManager(cfg.run, command_of, lambda _level, _text: None)
        stack.callback(children.kill_all)
        stack.callback(children.stop_all)
        for process in PROCESSES:
            if process.is_simulator:
                children.start(process)
        yield cfg


async def probe_robot(cfg: Config, mirror: Mirror, listen_s: float = LISTEN_S) -> list[PreflightResult]:
    """Join the robot as monitor, receive for ``listen_s``, and check its frames.

    The robot stays held, because this monitor sends no permit.
    """
    frames: list[Sensors] = []
    arrived_s: list[float] = []
    hellos: list[Hello] = []
    is_first: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    is_lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def take(sensors: Sensors, _raw: bytes) -> None:
        frames.append(sensors)
        arrived_s.append(time.monotonic())
        if not is_first.done():
            is_first.set_result(None)

    def without(finding: PreflightResult, why: str) -> list[PreflightResult]:
        return [*named(robot_link=finding), *skipped(ROBOT_CHECKS, why)]

    try:
        key = read_key(cfg.robot.key_file)
    except CcatpError as error:
        return without(failed(str(error), "see ccatp keys"), "no robot link")
    link = RobotLink(
        host=cfg.robot.host, port=cfg.robot.port, role="monitor", client="check", key=key,
        handler=LinkHandler(on_sensors=take, on_lost=is_lost.set_result, on_joined=hellos.append),
    )  # fmt: skip
    try:
        await link.connect(cfg.robot.connect_timeout_s)
        await asyncio.wait((is_first, is_lost), timeout=FIRST_FRAME_S, return_when=asyncio.FIRST_COMPLETED)
        if frames:
            await asyncio.wait((is_lost,), timeout=listen_s)
    except RobotLinkError as error:
        todo = "switch the robot on; check [robot] host, port and key_file; end what else drives it"
        if isinstance(error, ImpossibleRobot):
            todo = "the robot's own configuration (of ccatp onboard: [link] and [robot]) has to be corrected"
        return without(failed(str(error), todo), "no robot link")
    finally:
        link.close()
    if is_lost.done() or not frames:
        why = is_lost.result() if is_lost.done() else f"no sensors frame within {FIRST_FRAME_S:g} s"
        return without(failed(why, "read the robot's own log"), "no frames")
    hello = hellos[0]
    found = passed(f"{cfg.robot.host}:{cfg.robot.port}, {hello.protocol}, auth {hello.auth}")
    if hello.auth == "none" and not cfg.robot.host.startswith(_LOCAL):
        todo = "everyone on that network can drive it: give it a key (ccatp keys generate, robot.key_file)"
        found = warned(found.found, todo)
    return [*named(robot_link=found), *check_robot(RobotReport(cfg, mirror, hello, frames, arrived_s))]


async def probe_laser(cfg: Config, mirror: Mirror) -> list[PreflightResult]:
    """Request the state of the MultiLine server and a fix of the puck at base."""
    quick = cfg.etalon.model_copy(update={"reconnect_for_s": 0.0})
    client = EtalonClient(quick, mirror.channels, mirror.collimators_m)
    try:
        try:
            readiness = await client.isready()
        except EtalonError as error:
            todo = "start the MultiLine server; check [etalon] host and port"
            return [*named(laser_server=failed(str(error), todo)), *skipped(LASER_NAMES, "no laser server")]
        try:
            await asyncio.sleep(cfg.etalon.measuring_time_s)
            fix = await client.measure(0.0, mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m))
        except EtalonUnreachable as error:
            at_base = failed(str(error), "the server ended; read its log")
        except EtalonError as error:
            at_base = failed(str(error), "set the robot down at base, with a free view for the beams")
        else:
            at_base = check_fix(cfg, mirror, fix)
        return named(
            laser_server=passed(f"{cfg.etalon.host}:{cfg.etalon.port}"),
            lasers=check_lasers(connected=readiness.connected, laser_ready=readiness.laser_ready),
            air=check_air(readiness.environment),
            laser_fix=at_base,
        )
    finally:
        await client.close()


def probe_machine(
    cfg: Config, runs_dir: Path, runtime_dir: Path | None, environ: Mapping[str, str]
) -> list[PreflightResult]:
    """Check clock, disk, runtime directory and real-time priority."""
    others = named(runtime_directory=_runtime_dir(cfg, runtime_dir, environ), real_time=_real_time(cfg))
    return [*named(machine_clock=_clock()), *_disk(runs_dir), *others]


def probe_key(cfg: Config, *, sim: bool) -> PreflightResult:
    """Check the key of the robot link."""
    try:
        key = read_key(cfg.robot.key_file, must_be_private=not sim)
    except CcatpError as error:
        return failed(str(error), "make one with ccatp keys generate, and give the robot the same")
    return passed(cfg.robot.key_file if key else "none configured")


def _observatory(cfg: Config) -> PreflightResult:
    try:
        keys = check_observatory(cfg.observatory)
    except ConfigError as error:
        return failed(str(error), "make them with ccatp keys generate")
    if keys is None:
        return passed("served at the unix socket alone")
    return passed(f"{cfg.observatory.endpoint}, listed in {cfg.observatory.clients_file}")


def _clock() -> PreflightResult:
    """Whether the machine's clock is synchronised: logs and recordings are compared by it."""
    found = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    if time.gmtime().tm_year < 2025:
        return failed(found, "set the clock; is its battery empty?")
    if sys.platform != "linux":
        return passed(found)
    # struct timex has 208 bytes; with its first field (modes) zero, adjtimex only reads the state.
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(256))
    if state in (-1, _TIME_ERROR):
        return warned(f"{found}, not synchronised", "logs may not fit those of others: start chrony or timesyncd")
    return passed(f"{found}, synchronised")


def _disk(runs_dir: Path) -> list[PreflightResult]:
    """Free space and write speed of the disk for runs; ``runs_dir`` itself may not exist before the first run."""
    place = runs_dir.absolute()
    if place.exists() and not place.is_dir():
        return named(disk=failed(f"{place} is no directory", "name another with --runs-dir"))
    if not place.is_dir():
        place = place.parent
    if not place.is_dir():
        found = f"no directory {place} to make {runs_dir.name} in"
        return named(disk=failed(found, "make it, or mount the disk it is on"))
    free = shutil.disk_usage(place).free
    space = passed(f"{free / 1e9:.1f} GB free in {place}")
    if free < FREE_BYTES:
        space = failed(space.found, f"make room: {FREE_BYTES / 1e9:.0f} GB are a day of recordings")
    try:
        slowest_s = _slowest_write_s(place)
    except OSError as error:
        writes = failed(f"{place}: {error.strerror}", "let the daemon's user write there, or use --run-dir")
    else:
        writes = passed(f"the slowest of {WRITES} took {1e3 * slowest_s:.1f} ms")
        if slowest_s > SLOW_WRITE_S:
            writes = warned(writes.found, "a point counts when it is on the disk: use a faster one")
    return named(disk_space=space, disk_writes=writes)


def _slowest_write_s(folder: Path) -> float:
    slowest_s = 0.0
    with tempfile.TemporaryFile(dir=folder) as file:
        for _ in range(WRITES):
            begin_s = time.monotonic()
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
            slowest_s = max(slowest_s, time.monotonic() - begin_s)
    return slowest_s


def _runtime_dir(cfg: Config, runtime_dir: Path | None, environ: Mapping[str, str]) -> PreflightResult:
    try:
        folder = make_runtime_dir(str(runtime_dir or cfg.run.runtime_dir), environ)
    except CcatpError as error:
        return failed(str(error), "choose another with --runtime-dir")
    try:
        with (folder / "lock").open("a") as file:
            flock(file, LOCK_EX | LOCK_NB)
    except OSError:
        return failed(f"a daemon runs in {folder}", "see it with ccatp status; end it with ccatp stop")
    return passed(str(folder))


def _real_time(cfg: Config) -> PreflightResult:
    priority = cfg.run.realtime_priority
    if not priority:
        return passed("not requested (run.realtime_priority = 0)")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
    if os.geteuid() == 0 or limit in (-1, resource.RLIM_INFINITY) or limit >= priority:
        return passed(f"priority {priority} is permitted")
    todo = "reaction times hold only while a core is idle: the unit grants it with LimitRTPRIO"
    return warned(f"priority {priority} is not permitted to this user", todo)
