"""THE table of the checks: what the page promises, how it is tested, and what that needs."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from ccatp.commissioning.conformance import judges as frames
from ccatp.commissioning.conformance import motion_checks as stories_frames
from ccatp.commissioning.conformance import motion_checks as stories_lockstep
from ccatp.commissioning.conformance import motion_checks as stories_motion
from ccatp.commissioning.conformance import rule_checks as stories_fans
from ccatp.commissioning.conformance import rule_checks as stories_rules
from ccatp.commissioning.conformance import session_checks as stories_input
from ccatp.commissioning.conformance import session_checks as stories_session
from ccatp.commissioning.conformance.connections import CheckContext

Need = Literal["motion", "real time", "lockstep", "hmac"]


class Check(NamedTuple):
    """One row.

    Attributes:
        story: plays it; what was seen, or ``Broken`` or ``NotApplicable``.
        needs: without these it is not applicable.
    """

    check_id: str
    promise: str
    method: str
    story: Callable[[CheckContext], str]
    needs: tuple[Need, ...] = ()


_AGAIN = "one, an older one, and one more of the same number"
_FRAMES = "40 frames, each answered by a drive and a permit"
_FORWARD, _REVERSE, _TURN = (True, False, False), (False, True, False), (False, False, True)
_BAD = {
    "no-json": ("a line that is no JSON is dropped", "a drive without its last brace"),
    "key-twice": ("a key that stands twice makes a bad line", "a drive with two wr"),
    "nan": ("numbers are finite", "a drive with NaN"),
    "infinity": ("numbers are finite", "a drive with Infinity"),
    "overflow": ("numbers are finite", "a drive with 1e999"),
    "key-missing": ("a line that fails a check is dropped", "a drive without wl"),
    "text-for-number": ("a line that fails a check is dropped", "a drive with wr as text"),
    "no-utf-8": ("lines are UTF-8", "a drive with a byte that UTF-8 does not know"),
}

CHECKS: tuple[Check, ...] = (
    # -- hello --------------------------------------------------------------------------------------------------------
    Check("hello", "on accept the robot says hello: protocol, boot, nonce, auth, lockstep, frame_hz, ttl_s",
          "fields, types and ranges of one hello", stories_session.hello_fields),
    Check("hello-robot", "hello.robot describes wheels, edge sensors in their order, puck, limit and fan floor",
          "fields, shapes and ranges of one hello", stories_session.hello_robot),
    Check("nonce", "each connection has a nonce of its own", "the hellos of 8 connections", stories_session.nonces),
    Check("boot", "boot changes at a power-up only", "the hellos of 8 connections", stories_session.boots),
    # -- join ---------------------------------------------------------------------------------------------------------
    Check("join", "a join is answered by joined, with role and session", "both roles", stories_session.join_both),
    Check("join-in-time", "a client has 2 s to join", "a join 1 s after the hello", stories_session.join_in_time),
    Check("join-late", "a client that does not join within 2 s is refused and closed",
          "a join 2.1 s after the hello, unless refused before", stories_session.join_late),
    Check("join-role", "a role that does not exist is refused as bad join, and closed", 'role "king"',
          stories_session.join_unknown_role),
    Check("join-client", "a join without all its keys is refused as bad join, and closed", "a join without client",
          stories_session.join_without_client),
    Check("join-first", "the first message of a client is its join; others are refused as bad join", "a drive first",
          stories_session.command_before_join),
    Check("role-taken", "one controller and one monitor at most", "a second client for each role",
          stories_session.role_taken),
    Check("refused-harmless", "a refused client never disturbs the holder",
          "four refused clients while two others hold the roles", stories_session.refused_is_harmless),
    Check("take-over", "a role may be taken over after 5 s without a valid line of its holder, not before",
          "a holder that sends bad lines only; joins at 3.5 s and at 5.3 s", stories_session.take_over, ("real time",)),
    Check("mac", "a join with the right mac is accepted", "HMAC-SHA256 of nonce, colon and role",
          stories_session.mac_right, ("hmac",)),
    Check("mac-wrong", "a wrong mac is refused as bad mac, and closed", "a mac made with another key",
          stories_session.mac_wrong, ("hmac",)),
    Check("mac-missing", "a join without the mac that auth asks for is refused, and closed", "no mac",
          stories_session.mac_missing, ("hmac",)),
    Check("mac-nonce", "a mac belongs to one connection", "the right mac of another connection",
          stories_session.mac_of_another, ("hmac",)),
    Check("mac-role", "a mac belongs to one role", "the right mac of the other role",
          stories_session.mac_of_the_other_role, ("hmac",)),
    # -- sensors ------------------------------------------------------------------------------------------------------
    Check("frames-lines", "one JSON object a line, finite numbers, no key twice, at most 8192 bytes", _FRAMES,
          stories_frames.lines),
    Check("frames-seq", "seq of the frames increases", _FRAMES, stories_frames.judged(frames.judge_seq)),
    Check("frames-clock", "t is a monotonic clock in seconds; frames come at frame_hz", _FRAMES,
          stories_frames.clocked(frames.judge_clock)),
    Check("frames-samples", "imu, enc and edge are lists of samples, each with its time", _FRAMES,
          stories_frames.judged(frames.judge_shape)),
    Check("frames-times", "a list holds the samples since the last frame, oldest first", _FRAMES,
          stories_frames.judged(frames.judge_times)),
    Check("frames-rates", "IMU up to 100 Hz, encoders and edge sensors up to 1000 Hz", _FRAMES,
          stories_frames.judged(frames.judge_rates)),
    Check("frames-edge", "edge values are 0 or 1", _FRAMES, stories_frames.judged(frames.judge_edges)),
    Check("frames-gravity", "gravity is null, or a time and a unit vector", _FRAMES,
          stories_frames.judged(frames.judge_gravity)),
    Check("frames-state", "fans and soc are within 0 and 1", _FRAMES, stories_frames.judged(frames.judge_state)),
    Check("frames-faults", "faults holds names out of the page's list", _FRAMES,
          stories_frames.judged(frames.judge_faults)),
    Check("frames-cmd", "cmd holds seq, age, permit_age and held", _FRAMES, stories_frames.judged(frames.judge_cmd)),
    Check("frames-all", "every frame goes to every joined session", _FRAMES,
          stories_frames.compared(frames.judge_both)),
    Check("frames-joined", "frames go to joined sessions only", "a client that does not join, beside two that have",
          stories_frames.before_join),
    Check("echo", "cmd echoes the newest drive in force and its age", "20 frames, a new drive for each",
          stories_frames.echo),
    # -- keys ---------------------------------------------------------------------------------------------------------
    Check("no-permit", "once a monitor has joined, wheels are held without its permit", "drives of zero, no permit",
          stories_rules.no_permit, ("real time",)),
    Check("no-drive", "wheels are held without a drive", "permits, no drive", stories_rules.no_drive, ("real time",)),
    Check("ttl-drive", "a drive is in force for ttl_s", "drives of zero, then none", stories_rules.ttl("drive"),
          ("real time",)),
    Check("ttl-permit", "a permit is in force for ttl_s", "permits, then none", stories_rules.ttl("permit"),
          ("real time",)),
    Check("ttl-noise", "a bad line never refreshes a time-out", "drives of zero, then bad drives",
          stories_rules.noise_is_no_drive, ("real time",)),
    Check("newest-drive", "a drive with an older or equal seq is dropped", _AGAIN,
          stories_rules.newest_drive),
    Check("newest-permit", "a permit with an older or equal seq is dropped",
          _AGAIN, stories_rules.newest_permit),
    Check("role-drive", "drives are the controller's", "a drive of the monitor", stories_rules.wrong_role),
    Check("lost-controller-fin", "the controller's lost session holds the wheels within 50 ms",
          "FIN, and a permit right behind", stories_rules.lost("drive", "FIN"), ("real time",)),
    Check("lost-controller-rst", "the controller's lost session holds the wheels within 50 ms",
          "RST, and a permit right behind", stories_rules.lost("drive", "RST"), ("real time",)),
    Check("lost-monitor-fin", "the monitor's lost session holds the wheels within 50 ms",
          "FIN, and a drive right behind", stories_rules.lost("permit", "FIN"), ("real time",)),
    Check("lost-monitor-rst", "the monitor's lost session holds the wheels within 50 ms",
          "RST, and a drive right behind", stories_rules.lost("permit", "RST"), ("real time",)),
    # -- fans ---------------------------------------------------------------------------------------------------------
    Check("fans", "duties stay in force until changed", "a duty changed by 0.05", stories_fans.obeyed),
    Check("newest-fans", "a fans command with an older or equal seq is dropped",
          _AGAIN, stories_fans.newest),
    Check("role-fans", "fans are the controller's", "a command of the monitor", stories_fans.of_the_monitor),
    Check("fans-ttl", "fans are never changed by a time-out", "no drive and no permit for longer than ttl_s",
          stories_fans.after_time_out, ("real time",)),
    Check("fans-stop", "fans are never changed by a stop", "a permit that allows nothing", stories_fans.after_stop),
    Check("fans-fin", "fans are never changed by a lost session", "FIN of both sessions",
          stories_fans.after_lost("FIN")),
    Check("fans-rst", "fans are never changed by a lost session", "RST of both sessions",
          stories_fans.after_lost("RST")),
    Check("fan-floor", "a duty below fan_floor is clamped to it, without a fault", "a duty 0.05 below",
          stories_fans.floor),
    # -- lines --------------------------------------------------------------------------------------------------------
    *(Check(kind, promise, f"{method}, a good drive with a lower seq behind it", stories_input.dropped(kind))
      for kind, (promise, method) in _BAD.items()),
    Check("unknown-key", "unknown keys are ignored", "a drive with two more keys", stories_input.unknown_key),
    Check("unknown-type", "an unknown type is ignored, and no bad line", "40 lines at once",
          stories_input.unknown_type),
    Check("bad-lines-few", "20 bad lines in a second do not close the session", "20 bad lines at once",
          stories_input.few_bad_lines),
    Check("bad-lines-many", "more than 20 bad lines in a second close the session", "21 bad lines at once",
          stories_input.many_bad_lines),
    Check("line-longest", "a line holds up to 8192 bytes", "a drive of 8192 bytes with its LF",
          stories_input.longest_line),
    Check("line-too-long", "a line over 8192 bytes closes the session", "with and without LF", stories_input.long_line),
    Check("single-bytes", "one object a line, however TCP chops it", "join and drive byte by byte",
          stories_input.single_bytes),
    Check("many-lines", "one object a line, however many come at once", "150 drives in one segment",
          stories_input.many_lines),
    Check("glued-lines", "one object a line, however TCP glues them", "three messages in one segment",
          stories_input.glued_lines),
    # -- lockstep -----------------------------------------------------------------------------------------------------
    Check("lockstep-drive", "time waits for a drive with ack = k", "a permit alone, then both",
          stories_lockstep.waits_for_drive, ("lockstep",)),
    Check("lockstep-permit", "once a monitor has joined, time waits for a permit with ack = k",
          "a drive alone, then both", stories_lockstep.waits_for_permit, ("lockstep",)),
    Check("lockstep-ack", "only answers to frame k advance the clock", "answers to frame k-1",
          stories_lockstep.waits_for_this_frame, ("lockstep",)),
    Check("lockstep-step", "the clock advances to k+1", "one drive and one permit", stories_lockstep.one_step,
          ("lockstep",)),
    Check("lockstep-ages", "ages are measured on the simulated clock; a client may hold its answer back",
          "an answer held back for longer than ttl_s", stories_lockstep.time_stands_still, ("lockstep",)),
    # -- motion -------------------------------------------------------------------------------------------------------
    Check("move-forward", "v > 0 needs forward", "forward, denied and allowed",
          stories_motion.direction(1, 1, _FORWARD, (False, True, True)), ("motion",)),
    Check("move-reverse", "v < 0 needs reverse", "reverse, denied and allowed",
          stories_motion.direction(-1, -1, _REVERSE, (True, False, True)), ("motion",)),
    Check("move-turn", "different wheel rates need turn", "a turn in place, denied and allowed",
          stories_motion.direction(1, -1, _TURN, (True, True, False)), ("motion",)),
    Check("move-turn-back", "different wheel rates need turn", "the turn back, denied and allowed",
          stories_motion.direction(-1, 1, _TURN, (True, True, False)), ("motion",)),
    Check("move-curve", "a curve forward needs forward and turn", "a curve, denied and allowed",
          stories_motion.direction(1, 0.5, (True, False, True), _FORWARD), ("motion",)),
    Check("move-curve-back", "a curve in reverse needs reverse and turn", "the curve back, denied and allowed",
          stories_motion.direction(-1, -0.5, (False, True, True), _TURN), ("motion",)),
    Check("wheels-ttl", "wheels stop when the drive is older than ttl_s", "forward, then no drive",
          stories_motion.stops_after_ttl, ("motion", "real time")),
    Check("wheels-lost", "wheels stop when the controller's session is lost", "reverse, then FIN",
          stories_motion.stops_when_lost, ("motion", "real time")),
)  # fmt: skip


def check_ids() -> tuple[str, ...]:
    """The names of all checks, in the order in which they run."""
    return tuple(check.check_id for check in CHECKS)
