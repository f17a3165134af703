"""Every order of events between main, danger and robot: an exploration of the real rules of the two keys.

The robot is the real ``RobotServer`` with the real ``LinkedRobot``, main and danger are their real sending rules
(``ccatp.links.frame_answers``). Between them is a link that delivers, loses, repeats, reorders and delays everything.
Main answers a frame with any drive, and danger judges it in any way, so no behaviour of the rest of the program is
assumed. ``Reference`` is the interface control document in its own words; it shares no code with the rules.

Two states with the same key behave in the same way: the rules only compare numbers and differences of times, so the key
has the order of numbers, and ages up to just above the time to live. So the number of states is finite.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ccatp.core import NO_CAUSE, EventCode, Verdict
from ccatp.links.frame_answers import DriveRule, FrameStamp, PermitRule, is_restart
from ccatp.links.robot_messages import Drive, Join, Permit, RobotData, Role
from ccatp.onboard.rules import LinkedRobot
from ccatp.onboard.sessions import ClientSession, RobotServer

FIRST = 1000  # number of the first frame, so that a robot can count from below
HZ, TTL = 100.0, 2  # the time to live in ticks, a tick is a frame
LATEST = 3  # a message arrives at most so many ticks late, or never
FAR = 6  # a number that is so far below is only older
NEAR = 20  # no number is so far above
GAPS = (0, 1, 4)  # by which a restarted robot counts from below; the rules only compare, so it need not be from 0
Allowed = tuple[bool, bool, bool]
Pair = tuple[float, float]
NOTHING: Allowed = (False, False, False)
# A direction of motion: its drive (right, left), and whether permits allow it.
DIRECTIONS: dict[str, tuple[Pair, Callable[[Allowed], bool]]] = {
    "forward": ((1.0, 1.0), lambda allowed: allowed[0]),
    "reverse": ((-1.0, -1.0), lambda allowed: allowed[1]),
    "turn": ((1.0, -1.0), lambda allowed: allowed[2]),
}
STILL: Pair = (0.0, 0.0)
DATA = RobotData(0.03, 0.15, ((0.1, 0.1),) * 4, (0.0, 0.0, 0.0), 8.0, 0.0)


class Violation(AssertionError):
    """The rules do something else than the interface control document says."""


def clone(thing: Any) -> Any:
    """A shallow copy of a plain object; ``copy.copy`` takes several times as long."""
    found = object.__new__(type(thing))
    found.__dict__.update(thing.__dict__)
    return found


def permits_of(one: Permit | Verdict) -> Allowed:
    """The motion that is allowed: forward, reverse, turn."""
    return one.forward, one.reverse, one.turn


class Robot(LinkedRobot):
    """A robot that has wheels and nothing else."""

    wheels: Pair = STILL

    def describe(self) -> RobotData:
        return DATA

    @property
    def delivered_line(self) -> bytes:
        return b""

    def advance(self) -> None:
        self._release_commands()
        self.seq += 1
        self.t_s, self.delivered_seq = self.seq / self.frame_hz, self.seq
        self.wheels = self.rules.set_points(self.t_s)

    def copied(self) -> "Robot":
        found: Robot = clone(self)
        found.rules, found._waiting, found._newest = clone(self.rules), deque(self._waiting), dict(self._newest)
        return found


class Session(ClientSession):
    """The robot's end of a connection."""

    def write(self, data: bytes) -> None:
        """Frames are delivered by the model."""

    def close(self) -> None:
        """The model has no socket."""


class Frame(NamedTuple):
    """A frame on its way: number, whether it is of the robot's present boot, ticks on its way."""

    seq: int
    is_present: bool
    waited: int = 0


class Sent(NamedTuple):
    """A command on its way; ``allowed``: by the verdict on the frame that it answers, if that was judged."""

    command: Drive | Permit
    allowed: Allowed | None
    waited: int = 0


@dataclass
class Connection:
    """One connection of a client: both ends, and what is on its way; ``generation`` for the reference."""

    role: Role
    generation: int
    session: Session
    is_served: bool = True  # the robot has not noticed its end
    is_open: bool = True  # the client has not noticed its end
    newest: int = 0  # number of the newest command that was sent
    down: tuple[Frame, ...] = ()
    up: tuple[Sent, ...] = ()


class Reference:
    """What the interface control document says of motion, for the messages that arrive."""

    def __init__(self) -> None:
        self.has_monitor = False
        self.newest: dict[Role, Sent | None] = {"controller": None, "monitor": None}
        self.ages = {"controller": 0, "monitor": 0}

    def copied(self) -> "Reference":
        found: Reference = clone(self)
        found.newest, found.ages = dict(self.newest), dict(self.ages)
        return found

    def begin(self, role: Role) -> None:
        """A client has joined, or its session has ended."""
        self.newest[role] = None

    def take(self, role: Role, sent: Sent) -> None:
        """Take a command of the present session."""
        newest = self.newest[role]
        if newest is None or sent.command.seq > newest.command.seq:
            self.newest[role], self.ages[role] = sent, 0

    def tick(self) -> Pair:
        """The set points of the wheels in the next tick."""
        for role in self.ages:
            self.ages[role] = min(self.ages[role] + 1, TTL + 1)
        drive, permit = self.newest["controller"], self.newest["monitor"]
        if drive is None or self.ages["controller"] > TTL:
            return STILL
        assert isinstance(drive.command, Drive)
        set_points = drive.command.wr, drive.command.wl
        if self.has_monitor:
            if permit is None or permit.allowed is None or self.ages["monitor"] > TTL:
                return STILL
            if not any(pair == set_points and may(permit.allowed) for pair, may in DIRECTIONS.values()):
                return STILL
        return set_points


@dataclass
class Danger:
    """The danger process: its rule, and what it remembers of the session before."""

    rule: PermitRule = field(default_factory=PermitRule)
    sessions: int = 0
    before: FrameStamp | None = None
    newest: FrameStamp | None = None  # of the session, as the link counts
    allowed: Allowed | None = None  # for the reference: the verdict on the newest frame, if it was judged
    is_present: bool = True  # for the reference: the newest frame is of the robot's present boot
    highest: int = -1  # for the reference: the newest frame of the present boot that was judged
    deaf_to: int = -1  # for the reference: up to this number, frames may be those of the session before


@dataclass
class Main:
    """The main process."""

    rule: DriveRule = field(default_factory=DriveRule)
    newest: int = -1


@dataclass(frozen=True)
class Bounds:
    """What is explored: direction of the drives; largest number of frames and commands on their way in a connection.

    ``free``: the clients with a process, a link and a rule. A client that is not free is an ideal one: its newest
    command is always fresh, of its session, and allows all. ``gaps``: of restarts of the robot, as in ``GAPS``.
    ``repeats``: whether a message may come again. ``judges``: whether verdicts may deny. ``drives_still``: whether
    main may also send a zero drive. The rest are the rules, which mutants replace.
    """

    direction: str = "forward"
    free: tuple[Role, ...] = ("controller", "monitor")
    frames: int = 1
    commands: int = 1
    gaps: tuple[int, ...] = GAPS
    repeats: bool = True
    judges: bool = True
    drives_still: bool = False
    makes_permits: Callable[[], PermitRule] = PermitRule
    makes_drives: Callable[[], DriveRule] = DriveRule
    restarted: Callable[[FrameStamp, FrameStamp], bool] = is_restart
    makes_robot: Callable[[], Robot] = lambda: Robot((TTL / HZ, 8.0, 0.0), 1.0 / HZ, HZ)
    makes_server: Callable[[Robot], RobotServer] = lambda robot: RobotServer(robot, lockstep=False)

    @property
    def verdicts(self) -> tuple[Allowed, Allowed]:
        """All motion, and all but the direction of the drives."""
        others = tuple(name != self.direction for name in DIRECTIONS)
        return (True, True, True), (others[0], others[1], others[2])


class World:
    """One state: robot, clients, link, reference. An event changes it in place, so copy it before."""

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self.boot(FIRST)
        self.reference = Reference()
        self.links: dict[Role, Connection | None] = {"controller": None, "monitor": None}
        self.old: tuple[Connection, ...] = ()  # of clients that have lost or left them; one for each role
        self.generation = 0
        self.main, self.danger = Main(bounds.makes_drives()), Danger(bounds.makes_permits())
        self.moves = False

    def boot(self, seq: int) -> None:
        """Start a robot whose frames count from ``seq``."""
        self.robot = robot = self.bounds.makes_robot()
        robot.seq, robot.t_s = seq, seq / HZ
        self.server = self.bounds.makes_server(robot)
        self.server.begin(0.0)
        self.ideal = 0  # number of the newest command of an ideal client
        for role in {"controller", "monitor"} - set(self.bounds.free):
            robot.join(role)  # type: ignore[arg-type]

    def copied(self) -> "World":
        """The same state, to be changed."""
        found: World = clone(self)
        found.robot, found.server = self.robot.copied(), clone(self.server)
        found.server.robot = found.robot
        found.server._sessions, found.server._acked = set(), set()
        found.server._holders = {}
        found.links = {}
        for role, link in self.links.items():
            found.links[role] = None if link is None else self._moved(found, link)
        found.old = tuple(self._moved(found, link) for link in self.old)
        found.reference, found.main, found.danger = self.reference.copied(), clone(self.main), clone(self.danger)
        found.main.rule, found.danger.rule = clone(self.main.rule), clone(self.danger.rule)
        return found

    def _moved(self, found: "World", link: Connection) -> Connection:
        copied: Connection = clone(link)
        copied.session = clone(link.session)
        if link.session._server is self.server:
            copied.session._server = found.server
            if self.server._holders.get(link.role) is link.session:
                found.server._holders[link.role] = copied.session
        return copied

    # -- events ---------------------------------------------------------------------------------------------------

    def events(self) -> Iterator[tuple[Any, ...]]:
        """Every event that may happen now: the name of a method, and its arguments."""
        yield ("tick",)
        highest = max(self._numbers())
        for gap in self.bounds.gaps:
            if highest <= self.robot.seq + max(GAPS) - gap:
                yield "restart_robot", gap
        for role in self.bounds.free:
            yield "restart_client", role
            link = self.links[role]
            if link is not None:
                yield from self._events_of(link)
            elif role not in self.server._holders:
                yield "join", role, False
                yield "join", role, True
        for k, link in enumerate(self.connections):
            if link.is_served:
                yield "notice", k
            for n in range(len(link.up)):
                yield "command", k, n, False
                if link.is_served and self.bounds.repeats:
                    yield "command", k, n, True
                yield "lose_command", k, n

    def _events_of(self, link: Connection) -> Iterator[tuple[Any, ...]]:
        role = link.role
        yield "lose_link", role
        yield "repeat_answer", role
        newest = self.main.newest if role == "controller" else self.danger.newest.seq if self.danger.newest else -1
        for k, frame in enumerate(link.down):
            answers = self._answers(role)
            for answer in answers if frame.seq > newest else answers[:1]:
                yield "frame", role, k, answer, False
                if self.bounds.repeats:
                    yield "frame", role, k, answer, True
            yield "lose_frame", role, k

    def _answers(self, role: Role) -> tuple[Any, ...]:
        if role == "monitor":
            # None: the frame is not judged.
            return (*self.bounds.verdicts, None) if self.bounds.judges else self.bounds.verdicts[:1]
        drive = DIRECTIONS[self.bounds.direction][0]
        # None: the answer is withheld.
        return (drive, None, STILL) if self.bounds.drives_still else (drive, None)

    def _numbers(self) -> Iterator[int]:
        """Every frame number that somebody remembers: all must stay near that of the robot."""
        main, danger = self.main, self.danger
        yield from (main.newest, main.rule._frame_seq, danger.rule._highest_seq)
        yield from (frame.seq for link in self.connections for frame in link.down)
        for frame in (danger.before, danger.newest, danger.rule._newest):
            if frame is not None:
                yield frame.seq

    @property
    def connections(self) -> tuple[Connection, ...]:
        """Every connection on which something may be on its way."""
        return (*(link for link in self.links.values() if link is not None), *self.old)

    def tick(self) -> None:
        """The robot drives one frame and sends it."""
        robot, bounds, reference = self.robot, self.bounds, self.reference
        for role in {"controller", "monitor"} - set(bounds.free):
            self.ideal += 1
            drive = DIRECTIONS[bounds.direction][0]
            if role == "controller":
                robot.drive(self.ideal, *drive)
                reference.take("controller", Sent(Drive(self.ideal, 0, *drive), None))
            else:
                robot.permit(self.ideal, True, True, True)
                reference.take("monitor", Sent(Permit(self.ideal, 0, True, True, True), (True, True, True)))
        if "monitor" not in bounds.free:
            reference.has_monitor = True
        self.server.tick(robot.next_t_s)
        should = reference.tick()
        if robot.wheels != should:
            raise Violation(f"the wheels turn by {robot.wheels}, and should by {should}")
        if robot.rules.is_held and robot.wheels != STILL:
            raise Violation("the echo says held, and the wheels turn")
        self.moves = robot.wheels != STILL
        for link in self.connections:
            link.up = tuple(sent._replace(waited=sent.waited + 1) for sent in link.up if sent.waited < LATEST)
            frames = [one._replace(waited=one.waited + 1) for one in link.down if one.waited < LATEST]
            if link.is_served and link.is_open:
                frames.append(Frame(robot.seq, is_present=True))
            link.down = tuple(frames[-bounds.frames :])

    def restart_robot(self, gap: int) -> None:
        """The robot restarts, with the same boot number, and counts from ``gap`` below. Frames of before may come."""
        self.boot(self.robot.seq - gap)
        self.reference = Reference()
        for link in self.connections:
            link.is_served, link.up = False, ()
            link.session.is_open, link.session.role = False, None
            link.down = tuple(frame._replace(is_present=False) for frame in link.down)
        self.danger.highest, self.danger.is_present = -1, False

    def restart_client(self, role: Role) -> None:
        """Main or danger is replaced; the kernel closes its connection."""
        if role == "controller":
            self.main = Main(self.bounds.makes_drives())
        else:
            self.danger = Danger(self.bounds.makes_permits())
        self._leave(role)

    def lose_link(self, role: Role) -> None:
        """A client notices the end of its session; the robot may notice it later, or earlier."""
        danger = self.danger
        if role == "monitor" and danger.newest is not None:
            danger.before = danger.newest
        self._leave(role)

    def _leave(self, role: Role) -> None:
        link = self.links[role]
        if link is None:
            return
        link.is_open, link.down = False, ()
        self.links[role] = None
        kept = tuple(one for one in self.old if one.role != role or one.is_served)
        self.old = (*kept, link) if link.is_served or link.up else kept

    def notice(self, k: int) -> None:
        """The robot notices the end of a session, or closes it."""
        link = self.connections[k]
        link.is_served = False
        self.server.lost(link.session)
        self.reference.begin(link.role)

    def join(self, role: Role, has_frame: bool) -> None:
        """A client joins; ``has_frame``: the robot sends it the newest frame again, as in lockstep."""
        self.generation += 1
        session = Session(self.server)
        session.joined_s = session.received_s = self.robot.t_s
        self.server.join(session, Join(role=role, client=role), self.robot.t_s)
        if session.role != role:
            raise Violation("a free role is refused")
        down = (Frame(self.robot.seq, is_present=True),) if has_frame else ()
        self.links[role] = Connection(role, self.generation, session, down=down)
        self.reference.begin(role)
        if role == "controller":
            self.main.rule.begin_session()
            self.main.newest = -1
            return
        self.reference.has_monitor = True
        danger = self.danger
        danger.sessions += 1
        danger.newest = danger.allowed = None
        danger.rule.begin_session()

    def frame(self, role: Role, k: int, answer: Any, is_kept: bool) -> None:
        """A frame reaches a client, which answers a new one in some way; ``is_kept``: it will come again."""
        link = self._link(role)
        frame = link.down[k]
        if not is_kept:
            link.down = link.down[:k] + link.down[k + 1 :]
        (self._drive if role == "controller" else self._judge)(link, frame, answer)

    def _drive(self, link: Connection, frame: Frame, answer: Pair | None) -> None:
        main = self.main
        if frame.seq > main.newest:  # what the link passes on
            main.newest = frame.seq
            main.rule.take(frame.seq)
            if answer is not None:
                self._send_drive(link, main.rule.drive(frame.seq, *answer))
        elif frame.seq == main.newest:
            self._send_again(link)

    def _judge(self, link: Connection, frame: Frame, answer: Allowed | None) -> None:
        danger = self.danger
        known = FrameStamp(0, danger.sessions, frame.seq, frame.seq / HZ)
        if danger.newest is not None and known.seq <= danger.newest.seq:
            if known == danger.newest:
                self._send_again(link)
            return
        if danger.newest is None and danger.before is not None:
            # The last frame again, or a restarted robot that shows the same number and time: it is not judged twice.
            danger.deaf_to = danger.before.seq if known.seq >= danger.before.seq else -1
            if self.bounds.restarted(danger.before, known):
                danger.rule.restart()
        danger.newest, danger.allowed, danger.is_present = known, None, frame.is_present
        if danger.rule.take(known):
            danger.allowed = answer
            if answer is not None:
                danger.rule.judge(Verdict(known.seq, known.t_s, EventCode.NORMAL, NO_CAUSE, "", 0.0, 0.0, *answer))
            if frame.is_present and frame.seq <= danger.highest:
                raise Violation(f"frame {frame.seq} is judged twice")
            danger.highest = frame.seq if frame.is_present else danger.highest
        elif frame.is_present and frame.seq > max(danger.highest, danger.deaf_to):
            raise Violation(f"frame {frame.seq} is new and is not judged")
        self._send_permit(link)

    def repeat_answer(self, role: Role) -> None:
        """A client repeats its newest answer."""
        self._send_again(self._link(role))

    def _send_again(self, link: Connection) -> None:
        if link.role == "monitor":
            self._send_permit(link)
        elif (drive := self.main.rule.repeat()) is not None:
            self._send_drive(link, drive)

    def _send_drive(self, link: Connection, drive: Drive) -> None:
        if (drive.wr or drive.wl) and drive.ack != self.main.newest:
            raise Violation(
                f"a drive that moves for frame {drive.ack}; the newest of the session is {self.main.newest}"
            )
        self._send(link, Sent(drive, None))

    def _send_permit(self, link: Connection) -> None:
        permit = self.danger.rule.permit()
        if permit is None:
            return
        allowed, motion = self.danger.allowed, permits_of(permit)
        if motion != (allowed or NOTHING):
            raise Violation(f"the permit on frame {permit.ack} is {motion}, the verdict on it {allowed}")
        self._send(link, Sent(permit, allowed))

    def _send(self, link: Connection, sent: Sent) -> None:
        if sent.command.seq <= link.newest:
            raise Violation(f"number {sent.command.seq} follows {link.newest}")
        link.newest = sent.command.seq
        if link.is_served:
            link.up = (*link.up, sent)[-self.bounds.commands :]

    def command(self, k: int, n: int, is_kept: bool) -> None:
        """A command reaches the robot; ``is_kept``: it comes again."""
        link = self.connections[k]
        sent = link.up[n]
        if not is_kept:
            link.up = link.up[:n] + link.up[n + 1 :]
        role = link.session.role
        if role is not None:  # as in ``ClientSession``
            self.server.command(link.session, role, sent.command, self.robot.t_s)
        if link.is_served:
            self.reference.take(link.role, sent)

    def lose_frame(self, role: Role, k: int) -> None:
        """A frame is lost."""
        link = self._link(role)
        link.down = link.down[:k] + link.down[k + 1 :]

    def lose_command(self, k: int, n: int) -> None:
        """A command is lost."""
        link = self.connections[k]
        link.up = link.up[:n] + link.up[n + 1 :]

    def _link(self, role: Role) -> Connection:
        link = self.links[role]
        assert link is not None
        return link

    # -- equal states ---------------------------------------------------------------------------------------------

    def key(self) -> int:
        """A number of 64 bits for all that the future depends on: equal for states that behave in the same way.

        Two of a million states have the same number by chance once in 40 million explorations.
        """
        return hash(self._parts())

    def _parts(self) -> tuple[object, ...]:
        rules, reference, main, danger = self.robot.rules, self.reference, self.main, self.danger
        judged, drive = danger.rule._judged, main.rule._newest
        links = {role: None if link is None else self._key_of(link) for role, link in self.links.items()}
        return (
            None if rules._drive is None else (rules._drive, self._age(rules._drive_s)),
            None if rules._permit is None else (rules._permit, self._age(rules._permit_s)),
            rules.has_monitor_joined,
            tuple((due - self.robot.seq, kind, values[:3]) for due, kind, _, values in self.robot._waiting),
            reference.has_monitor,
            tuple(
                None if one is None else (self._values(one), reference.ages[role])
                for role, one in reference.newest.items()
            ),
            links["controller"],
            links["monitor"],
            tuple(sorted((link.role, self._key_of(link)) for link in self.old)),
            self._ago(main.newest if links["controller"] else -1),
            main.rule._frame_seq == main.newest,
            None if drive is None else (drive.ack == main.newest, drive.wr, drive.wl),
            None if danger.before is None else self._ago(danger.before.seq),
            None if danger.newest is None or links["monitor"] is None else self._ago(danger.newest.seq),
            danger.rule._newest == danger.newest,
            None if judged is None else (judged.frame == danger.newest, *permits_of(judged.verdict)),
            self._ago(danger.rule._highest_seq),
            danger.allowed,
            danger.is_present,
            self._ago(danger.highest),
            self._ago(danger.deaf_to),
        )

    def _age(self, since_s: float) -> int:
        return min(self.robot.seq - round(since_s * HZ), TTL + 1)

    def _ago(self, seq: int) -> int:
        # Positive, because -1 and -2 have the same hash.
        return NEAR + (FAR if seq < 0 else min(self.robot.seq - seq, FAR))

    @staticmethod
    def _values(sent: Sent) -> tuple[object, ...]:
        one = sent.command
        return (one.wr, one.wl) if isinstance(one, Drive) else (*permits_of(one), str(sent.allowed))

    def _key_of(self, link: Connection) -> tuple[object, ...]:
        newest = self.robot._newest["drive" if link.role == "controller" else "permit"]
        taken = self.reference.newest[link.role]
        numbers = sorted({newest, -1 if taken is None else taken.command.seq, *(sent.command.seq for sent in link.up)})
        order = {number: k for k, number in enumerate(numbers)}
        up = sorted((order[sent.command.seq], self._values(sent), sent.waited) for sent in link.up)
        down = [(self._ago(frame.seq), frame.is_present, frame.waited) for frame in link.down]
        return link.is_served, link.is_open, order[newest], tuple(up), tuple(down)


# By the key of a state: the one before, and the event between them.
Ways = dict[int, tuple[int | None, tuple[Any, ...]]]


class Explored(NamedTuple):
    """How much was explored; ``is_whole``: every state that can be reached. ``moving``: states after a motion."""

    states: int
    transitions: int
    depth: int
    is_whole: bool
    moving: int


def explore(bounds: Bounds, depth: int = 10_000, states: int = 10_000_000) -> Explored:
    """Visit every state, breadth first, up to a depth in events or a number of states.

    Raises ``Violation`` with the shortest way to it.
    """
    first = World(bounds)
    ways: Ways = {first.key(): (None, ())}
    level, reached, transitions, moving = [(first.key(), first)], 0, 0, 0
    while level and reached < depth and len(ways) < states:
        reached += 1
        found = list[tuple[int, World]]()
        for here, world in level:
            for event in world.events():
                there = world.copied()
                transitions += 1
                try:
                    getattr(there, event[0])(*event[1:])
                except Violation as error:
                    raise Violation(f"{error}, after {way_to(ways, here)} and {event}") from error
                key = there.key()
                if key not in ways:
                    ways[key] = here, event
                    moving += there.moves
                    found.append((key, there))
        level = found
    return Explored(len(ways), transitions, reached, not level, moving)


def way_to(ways: Ways, key: int) -> list[object]:
    """The events that lead to a state."""
    events: list[object] = []
    before, event = ways[key]
    while before is not None:
        events.append(event)
        before, event = ways[before]
    return events[::-1]
