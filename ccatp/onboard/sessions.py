"""The robot's side of the robot link without sockets: sessions, roles, refusals, lockstep.

Bytes and time are arguments; a transport implements ``write`` and ``close``. There are two clocks: ``now_s`` is any
monotonic wall clock; the robot's own clock is the simulated one in lockstep and the wall clock since boot otherwise.

Choices the interface leaves open:

* Before the join, a malformed line and a message of unknown type are dropped and counted as after it. A malformed join,
  any other known message and no join within ``JOIN_TIMEOUT_S`` are refused as ``bad join``. ``busy`` means too many
  connections.
* A message that does not belong to the sender's role is a bad line. A message of unknown type keeps no role alive.
* In lockstep too, the time limits of sessions and roles are in wall time. A client that delays its answer repeats its
  last one meanwhile.
* Sequence numbers start again with each session.
* In lockstep a delay of the sensors has a constant length: each answer to the newest delivered frame drives one frame
  and delivers the next. A client's data are as old as the delay, as on a wall clock. The frames before the first
  delivery run when the controller joins, with the wheels held. The robot's delays represent those of the whole link.
* In lockstep the server does not wait for a frame that a fault removed or made invalid. Simulated time advances to the
  next frame that can be answered, by at most ``NO_DELIVERY_S``; then the sessions are closed.
* A planned reboot closes every session.
"""

import secrets
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from ccatp.links.robot_codec import BadLine, BadLineCounter, LineBuffer, decode_from_client, encode, is_mac_right
from ccatp.links.robot_messages import (
    AUTH_HMAC,
    AUTH_NONE,
    PROTOCOL,
    Drive,
    FromClient,
    Join,
    Joined,
    Permit,
    RefusalReason,
    Refused,
    Role,
    Unknown,
)
from ccatp.links.robot_messages import Fans as FansMessage
from ccatp.onboard.rules import LinkedRobot

JOIN_TIMEOUT_S = 2.0
SILENCE_S = 5.0
# Wall times in lockstep: an unanswered frame is sent again, is logged, and a silent client's session is closed.
REPEAT_S = 1.0
STALL_S = 5.0
LOCKSTEP_SILENCE_S = 60.0
MAX_LAG_S = 0.25
NO_DELIVERY_S = 60.0
MAX_SESSIONS = 32


class ServerLog(Protocol):
    """A structlog logger, or any object with this method."""

    def info(self, event: str, **fields: object) -> object:
        """Log one line with its fields."""


class ClientSession(ABC):
    """One client; a transport adds the sending of bytes.

    Attributes:
        joined_s: when it connected; wall clock.
        received_s: when it last sent a valid message; wall clock in lockstep, otherwise the robot's clock, so that a
            stop of the robot's own process does not count as silence of its clients.
        is_open: neither closed by the server nor lost.
    """

    def __init__(self, server: "RobotServer") -> None:
        self._server = server
        self.nonce = secrets.token_hex(16)
        self.role: Role | None = None
        self.joined_s = self.received_s = 0.0
        self.is_open = True
        self._lines = LineBuffer()
        self._bad = BadLineCounter()

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send without waiting."""

    @abstractmethod
    def close(self) -> None:
        """Close when everything is sent; receive nothing more."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Process received bytes, which may be a part of a line."""
        for line in self._lines.feed(data):
            if self.is_open:
                self._take(line, now_s)
        if self._lines.error is not None and self.is_open:
            self._server.counts["oversized_lines"] += 1
            self._server.drop(self, "line over the limit")

    def _take(self, line: bytes, now_s: float) -> None:
        try:
            message = decode_from_client(line)
            if isinstance(message, Unknown):
                self._server.counts["unknown_types"] += 1
            elif self.role is None:
                self._server.join(self, message, now_s)
            elif not self._server.command(self, self.role, message, now_s):
                raise BadLine("not for this role", type(message).__name__.lower())
        except BadLine as error:
            if self.role is None and error.message_type == "join":
                self._server.refuse(self, "bad join")
                return
            self._server.counts["bad_lines"] += 1
            if self._bad.add(now_s, str(error)):
                self._server.drop(self, f"too many bad lines, the first: {self._bad.first_reason}")


class RobotServer:
    """The server of the robot link; call ``begin`` first. Without an HMAC ``key`` there is no authentication.

    Attributes:
        counts: bad_lines, unknown_types, oversized_lines, refused, stale (drives, permits and fans not newer),
            slips (frames more than a period late), repeats (frames that were sent again in lockstep).
        oldest_ack_frames: largest age, in frames, of the frame acknowledged by a drive with a speed other than zero.
        each_frame: called after each frame that was driven and sent.
    """

    def __init__(
        self, robot: LinkedRobot, *, lockstep: bool, key: bytes | None = None, log: ServerLog | None = None
    ) -> None:
        self.robot = robot
        self.counts: Counter[str] = Counter(stale=0)
        self.oldest_ack_frames = self.fan_changes = 0
        self.each_frame: list[Callable[[], object]] = []
        self._is_lockstep, self._key, self._log = lockstep, key, log
        self._boot = secrets.randbits(31)
        self._sessions: set[ClientSession] = set()
        self._holders: dict[Role, ClientSession] = {}
        self._last_session = 0
        self._acked: set[Role] = set()  # roles that have answered the newest frame
        self._is_stall_noted = False
        self._reboots = robot.reboots

    def begin(self, now_s: float) -> None:
        """Start the robot's clock at ``now_s``."""
        self._boot_s = self._frame_wall_s = self._repeated_s = now_s

    def accept(self, session: ClientSession, now_s: float) -> None:
        """Send the hello to a client that has connected; refuse it when there are too many sessions."""
        session.joined_s = session.received_s = now_s
        auth, boot = AUTH_NONE if self._key is None else AUTH_HMAC, self._boot + self.robot.boot_count
        session.write(encode(self.robot.hello(boot=boot, nonce=session.nonce, auth=auth, lockstep=self._is_lockstep)))
        self._sessions.add(session)
        if len(self._sessions) > MAX_SESSIONS:
            self.refuse(session, "busy")

    def lost(self, session: ClientSession) -> None:
        """Remove a session whose connection is lost or will be closed: free its role and hold the wheels."""
        session.is_open = False
        self._sessions.discard(session)
        role, session.role = session.role, None
        if role is None or self._holders.get(role) is not session:
            return
        del self._holders[role]
        self.robot.lose(role)
        self._acked.discard(role)
        self._note(f"{role} lost: wheels held")

    def drop(self, session: ClientSession, why: str) -> None:
        """Close a session."""
        self._note(f"{session.role or 'client'} dropped: {why}")
        self.lost(session)
        session.close()

    def refuse(self, session: ClientSession, reason: RefusalReason) -> None:
        """Refuse a role to a client and close its session."""
        self.counts["refused"] += 1
        session.write(encode(Refused(reason=reason)))
        self.drop(session, f"refused: {reason}")

    def check_time(self, now_s: float) -> None:
        """Refuse clients that do not join; in lockstep handle an unanswered frame. Call it a few times a second."""
        for session in tuple(self._sessions):
            if session.role is None and now_s - session.joined_s > JOIN_TIMEOUT_S:
                self.refuse(session, "bad join")
        if not self._is_lockstep or "controller" not in self._holders:
            return
        if now_s - max(self._frame_wall_s, self._repeated_s) >= REPEAT_S:
            self._repeated_s = now_s
            self.counts["repeats"] += 1
            self._send_frame()
        for session in tuple(self._holders.values()):
            if now_s - max(session.received_s, self._frame_wall_s) > LOCKSTEP_SILENCE_S:
                self.drop(session, f"no line for {LOCKSTEP_SILENCE_S:g} s")
        if now_s - self._frame_wall_s > STALL_S and not self._is_stall_noted:
            self._is_stall_noted = True
            missing = "permit" if "controller" in self._acked else "drive"
            self._note(f"stall: frame {self.robot.delivered_seq} waits for its {missing}")

    def join(self, session: ClientSession, message: FromClient, now_s: float) -> None:
        """Handle the first message of a session that has no role yet."""
        # `check_time` may run after this message, so the time limit is also checked here.
        if not isinstance(message, Join) or now_s - session.joined_s > JOIN_TIMEOUT_S:
            self.refuse(session, "bad join")
            return
        if message.protocol != PROTOCOL:
            self.refuse(session, "bad protocol")
            return
        if self._key is not None and not is_mac_right(self._key, session.nonce, message):
            self.refuse(session, "bad mac")
            return
        clock_s = now_s if self._is_lockstep else self._robot_time_s(now_s)
        holder = self._holders.get(message.role)
        if holder is not None:
            if clock_s - holder.received_s <= SILENCE_S:
                self.refuse(session, "role taken")
                return
            self.drop(holder, "silent, taken over")
        self._holders[message.role] = session
        session.role, session.received_s = message.role, clock_s
        self._last_session += 1
        session.write(encode(Joined(role=message.role, session=self._last_session)))
        self._note(f"{message.role} joined: {message.client}")
        self._frame_wall_s, self._is_stall_noted = now_s, False
        self.robot.join(message.role)
        if not self._is_lockstep:
            return
        if message.role == "controller":
            self._send_frame()
            self._run_to_delivery()
        elif "controller" in self._holders:
            session.write(self.robot.delivered_line)

    def _run_to_delivery(self) -> None:
        """Run frames until one is delivered: no client can answer a frame that is delayed or lost."""
        robot, since_s = self.robot, self.robot.t_s
        while robot.delivered_seq < 0 and "controller" in self._holders:
            if robot.t_s - since_s > NO_DELIVERY_S:
                self._drop_all(f"no frame could be delivered for {NO_DELIVERY_S:g} s")
                return
            self._drive_frame()

    def command(self, session: ClientSession, role: Role, message: FromClient, now_s: float) -> bool:
        """Handle a message of a session that has a role; false when the message is not for this role."""
        robot, robot_s = self.robot, self._robot_time_s(now_s)
        if type(message) is Drive and role == "controller":
            taken = robot.drive(message.seq, message.wr, message.wl, robot_s, message.steer or 0.0)
            if taken and (message.wr or message.wl):
                self.oldest_ack_frames = max(self.oldest_ack_frames, robot.delivered_seq - message.ack)
        elif type(message) is Permit and role == "monitor":
            taken = robot.permit(message.seq, message.forward, message.reverse, message.turn, robot_s)
        elif type(message) is FansMessage and role == "controller":
            before = robot.fans.duty
            taken = robot.command_fans(message.seq, *message.duty)
            self.fan_changes += robot.fans.duty != before
        else:
            return False
        session.received_s = now_s if self._is_lockstep else robot_s
        if not taken:
            self.counts["stale"] += 1
        elif not isinstance(message, FansMessage) and message.ack == robot.delivered_seq:
            self._acked.add(role)
        acked = self._acked
        if self._is_lockstep and "controller" in acked and ("monitor" in acked or not robot.rules.has_monitor_joined):
            self._advance(now_s)
        return True

    @property
    def next_frame_s(self) -> float:
        """Wall time at which the next frame is due (not in lockstep)."""
        return self._boot_s + self.robot.next_t_s

    def tick(self, now_s: float) -> None:
        """Drive the frame that is due (not in lockstep). Late frames are driven afterwards, one per call.

        After a stop of this process over ``MAX_LAG_S`` the robot's clock continues from its value before the stop.
        """
        if self._skip_stop(now_s) > self.robot.frame_s:
            self.counts["slips"] += 1
        self._advance(now_s)

    def _skip_stop(self, now_s: float) -> float:
        """Set the clock back to its value before a stop over ``MAX_LAG_S``; return the delay of the next frame, s."""
        late_s = now_s - self.next_frame_s
        if late_s <= MAX_LAG_S:
            return late_s
        self.counts["slips"] += 1
        self._boot_s += late_s
        return 0.0

    def _advance(self, now_s: float) -> None:
        self._acked.clear()
        self._frame_wall_s, self._is_stall_noted = now_s, False
        self._drive_frame()
        if self._is_lockstep:
            self._run_to_delivery()

    def _drive_frame(self) -> None:
        """Drive a frame, send it, then call ``each_frame``, which runs while the clients process the frame."""
        self._advance_robot()
        self._send_frame()
        for call in self.each_frame:
            call()

    def _advance_robot(self) -> None:
        self.robot.advance()
        if self.robot.reboots != self._reboots:
            self._reboots = self.robot.reboots
            self._drop_all("the robot rebooted")

    def _drop_all(self, why: str) -> None:
        for session in tuple(self._sessions):
            self.drop(session, why)

    def _send_frame(self) -> None:
        line = self.robot.delivered_line
        if not line:
            return
        for role in ("controller", "monitor"):  # the controller has more to do
            session = self._holders.get(role)
            if session is not None:
                session.write(line)

    def _robot_time_s(self, now_s: float) -> float:
        robot_s = self.robot.t_s
        if self._is_lockstep:
            return robot_s
        # A command that is read before the first frame after a stop must not get a time in the future.
        self._skip_stop(now_s)
        return max(robot_s, now_s - self._boot_s)

    def _note(self, text: str) -> None:
        if self._log is not None:
            self._log.info("robot_session", text=text)
