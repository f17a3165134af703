"""THE table of conditions: everything that slows, pauses, holds, returns or stops the robot, one row per condition.

The danger loop may find several conditions at once. The one with the highest severity counts, then the one with the
lowest number in ``precedence``. Two exceptions for the verdict's cause: that of a declared edge stays unless a hold or
a fault is found; that of an emergency stays unless a return or a fault is found. Each other owner reports one condition
at a time. ``docs/alarms.md`` is generated from these rows. A mission may register rows of its own from another file.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import cache, partial
from importlib import import_module
from math import isfinite
from typing import NamedTuple, ParamSpec

from ccatp.core import ALL_MOTION, NO_MOTION, Cause, EventCode, Permits, Severity, Verdict
from ccatp.missions import SEARCHED, MissionKind, all_kinds


class Motion(Enum):
    """Motion that is still permitted."""

    ANY = "anything"
    RETREAT = "away from it"
    RETURN = "home"
    ABORT = "home, because it is called"
    NONE = "nothing"

    def permits(self, away: Permits = ALL_MOTION) -> Permits:
        """The permits of a verdict; ``away``: those of a retreat."""
        if self is Motion.NONE:
            return NO_MOTION
        return away if self is Motion.RETREAT else ALL_MOTION


class Clear(Enum):
    """What ends the reaction after the condition itself has ended."""

    AUTO = "by itself"
    AFTER_FIX = "after a fix"
    OPERATOR = "by an operator"


class Action(Enum):
    """Reactions to a condition."""

    EARTHQUAKE = "wheels held, then home"
    FAULT = "fault: held until an operator resumes"
    LOCATE = "hold: wheels held, one fix at rest, then held until it is over"
    HOLD = "hold: wheels held, a fix, then it continues by itself"
    SLOW = "half the speed"
    RETURN = "home"
    ABORT = "home, because it is called"
    WAIT = "hold: wheels held until no sensor hangs over"
    RETREAT = "back off"
    PAUSE = "pause: wheels held, continues by itself"
    KEEP_AWAY = "no motion towards it"
    INFORM = "reported"


# Severity of the verdict; that of the other actions is NONE, because event code and permits express them.
_SEVERITY = {
    Action.FAULT: Severity.FAULT,
    Action.RETURN: Severity.RETURN,
    Action.LOCATE: Severity.HOLD,
    Action.HOLD: Severity.HOLD,
    Action.PAUSE: Severity.PAUSE,
    Action.SLOW: Severity.SLOW,
    Action.INFORM: Severity.INFORM,
}
_CODE = dict.fromkeys((Action.RETREAT, Action.WAIT, Action.KEEP_AWAY), EventCode.NEAR_EDGE) | dict.fromkeys(
    (Action.EARTHQUAKE, Action.ABORT), EventCode.ABORTED
)
# Severity in the list of alarms of an action without one in the verdict.
_ALARM_SEVERITY = {
    Action.EARTHQUAKE: Severity.FAULT,
    Action.ABORT: Severity.RETURN,
    Action.WAIT: Severity.HOLD,
    Action.RETREAT: Severity.PAUSE,
    Action.KEEP_AWAY: Severity.INFORM,
}


class Owner(StrEnum):
    """The component that finds a condition."""

    DANGER = "danger loop"
    LOCALIZER = "localizer"
    MISSION = "mission"
    FIXES = "fix service"
    MAIN = "main loop"
    LINK = "robot link"
    OPERATOR = "operator"


ALONE = 0  # precedence of a condition that its owner never reports together with another one


class Group(StrEnum):
    """The chapters of the list of alarms."""

    EDGES = "Edges"
    DATA = "Data that are missing or old"
    SENSORS = "Edge sensors and inertial unit"
    WHEELS = "Wheels and encoders"
    FANS = "Fans and battery"
    LINK = "Link and clock"
    SURVEY = "The survey"
    STORAGE = "Storage"
    OBSERVATORY = "The observatory"


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """One row.

    ``name``: the public name, of alarms and events. ``precedence``: of findings with equal severity the lowest number
    counts. ``message``: text of the cause, with "{...}" for variable parts;
    ``meaning``: when it applies; ``advice``: what an operator can do. ``clear``: what ends a pause, a hold or a fault
    that the danger loop finds. ``limit``: key of the configuration with the time after which the action is
    ``escalates_to``. ``full_fans``: full fans meanwhile.
    ``retries``: how often it may repeat before it is a fault; ``None``: as configured.
    ``unit``: of the value against its limit. ``trusts_wheels``: what the wheels show in the hold is right.
    """

    name: str
    owner: Owner
    precedence: int
    group: str  # one of ``Group``, or a chapter of a mission's own
    message: str
    meaning: str
    advice: str
    action: Action
    motion: Motion
    clear: Clear | None = None
    limit: str = ""
    escalates_to: Action | None = None
    full_fans: bool = False
    retries: int | None = None
    unit: str = ""
    trusts_wheels: bool = False

    @property
    def severity(self) -> Severity:
        """Severity of the verdict."""
        return _SEVERITY.get(self.action, Severity.NONE)

    @property
    def code(self) -> EventCode:
        """Event code of a verdict about it alone."""
        return _CODE.get(self.action, EventCode.NORMAL)

    @property
    def raised_severity(self) -> Severity:
        """Severity after ``limit``; NONE if it does not rise."""
        return Severity.NONE if self.escalates_to is None else _SEVERITY[self.escalates_to]

    @property
    def alarm_severity(self) -> Severity:
        """Severity in the list of alarms; for an edge or an emergency it follows from the action."""
        return self.severity or _ALARM_SEVERITY[self.action]

    def cause(self, **values: object) -> Cause:
        """The condition as a cause; ``values``: of the variable parts of the message."""
        return Cause(self.name, {name: _plain(value) for name, value in values.items()})

    def found(self, signal: str, value: float, limit: float, **values: str) -> "MonitorFinding":
        """The finding that the condition applies: ``value`` against ``limit``; ``values``: parts of the message."""
        return MonitorFinding(self, self.severity, self.cause(**values), signal, value, limit, self.full_fans)


def _plain(value: object) -> int | float | str:
    """A value as it travels; a number that JSON has no form for, and any other object, as text."""
    if isinstance(value, str | int):
        return value
    return float(value) if isinstance(value, float) and isfinite(value) else str(value)


class MonitorFinding(NamedTuple):
    """A condition that applies, at present; ``value`` in the unit of ``limit``."""

    condition: Condition
    severity: Severity
    cause: Cause
    signal: str
    value: float
    limit: float
    full_fans: bool = False

    def verdict(self, seq: int, t_s: float, code: EventCode) -> Verdict:
        """The verdict on frame ``seq`` if nothing else is found."""
        permits = self.condition.motion.permits()
        return Verdict(
            seq, t_s, code, self.cause, self.signal, self.value, self.limit, *permits, severity=self.severity
        )


TABLE: dict[str, Condition] = {}  # the rows by name that this process has registered
P = ParamSpec("P")


@cache
def _register(kinds: Callable[[], Iterable[MissionKind]]) -> None:
    for kind in kinds():
        if kind.conditions:
            import_module(kind.conditions)


def find_condition(name: str) -> Condition | None:
    """The row of a name; ``None``: no kind of mission has it, or there is no cause."""
    for kinds in SEARCHED:
        if not name or name in TABLE:
            break
        _register(kinds)
    return TABLE.get(name)


def all_conditions() -> tuple[Condition, ...]:
    """The rows of every kind of mission."""
    _register(all_kinds)
    return tuple(TABLE.values())


def registered(make: Callable[P, Condition]) -> Callable[P, Condition]:
    """A function that makes a row and registers it. Raises ValueError: the name is taken."""

    def row(*args: P.args, **kwargs: P.kwargs) -> Condition:
        made = make(*args, **kwargs)
        if made.name in TABLE:
            raise ValueError(f"conditions: {made.name} is registered twice")
        TABLE[made.name] = made
        return made

    return row


# Usual fields of a row by its action; a row may override them.
_wait = partial(Condition, action=Action.PAUSE, motion=Motion.NONE, clear=Clear.AUTO)
inform = registered(partial(Condition, action=Action.INFORM, motion=Motion.ANY))
slow = registered(partial(Condition, action=Action.SLOW, motion=Motion.ANY))
wait = registered(_wait)
pause = registered(partial(_wait, limit="health.pause_limit_s", escalates_to=Action.HOLD))
hold = registered(
    partial(
        Condition,
        action=Action.HOLD,
        motion=Motion.NONE,
        clear=Clear.AFTER_FIX,
        limit="health.hold_limit_s",
        escalates_to=Action.FAULT,
    )
)
# More than ``health.retries`` of them within ``health.retry_window_s`` are a fault.
diverged = registered(partial(Condition, action=Action.HOLD, motion=Motion.NONE, clear=Clear.AFTER_FIX))
go_home = registered(partial(Condition, action=Action.RETURN, motion=Motion.RETURN))
fault = registered(partial(Condition, action=Action.FAULT, motion=Motion.NONE, clear=Clear.OPERATOR))
shaken = registered(partial(Condition, action=Action.EARTHQUAKE, motion=Motion.NONE))
edge = registered(partial(Condition, action=Action.RETREAT, motion=Motion.RETREAT))
near = registered(partial(Condition, action=Action.KEEP_AWAY, motion=Motion.RETREAT))


class SampleRate(NamedTuple):
    """Name of a sensor of the robot link, the rate that the daemon needs, and the rate below which it holds."""

    sensor: str
    least_hz: float
    hold_hz: float


SAMPLE_RATES = {
    # A reading in every other step of the filter; without any, the turn follows from the wheels alone.
    "imu": SampleRate("accelerometer and gyroscope", 20.0, 0.0),
    # The wheel monitors sum frames of 100 Hz, a fifth of which may be empty. At 20 Hz working wheels seem to stand.
    "enc": SampleRate("wheel encoders", 80.0, 40.0),
    # Two samples within a gap of 1.2 mm at 0.1 m/s, or at half of that.
    "edge": SampleRate("edge sensors", 200.0, 83.0),
    # 40 readings within the three seconds of the check; optional, and not needed afterwards.
    "gravity": SampleRate("gravity sensors", 14.0, 0.0),
}

# fmt: off
# -- sensors that are too slow; first, because they also cause findings about wheels and seams ------------------------

_RATE = "{sensor} deliver {rate} samples/s, at least {least} are needed"
_FIRMWARE = "Set the rate in the robot's firmware; the sensor and its cable work."
SENSOR_MUCH_TOO_SLOW = hold("sensor_much_too_slow", Owner.DANGER, 10, Group.SENSORS, _RATE,
    "Encoders or edge sensors deliver less than half of what is needed. The robot stands.", _FIRMWARE,
    trusts_wheels=True)
SENSOR_TOO_SLOW = slow("sensor_too_slow", Owner.DANGER, 20, Group.SENSORS, _RATE,
    "The sample rate is lower than needed at full speed. The robot continues at half its speed.", _FIRMWARE)

# -- wheels and encoders ----------------------------------------------------------------------------------------------

ENCODER_BROKEN = hold("encoder_broken", Owner.DANGER, 30, Group.WHEELS, "the {side} encoder {what}",
    "One encoder repeats itself, or gives no values, while the wheel must turn. The robot takes a fix and continues; "
    "repeated, it is a fault.", "Check its cable.")
WHEEL_RUNS_AWAY = hold("wheel_runs_away", Owner.DANGER, 40, Group.WHEELS, "the {side} wheel runs away",
    "It turns faster than commanded.", "Remove the robot: the servo fails.")
WHEEL_SPEED_WRONG = hold("wheel_speed_wrong", Owner.DANGER, 50, Group.WHEELS,
    "the {side} wheel turns {ratio} times as fast as commanded",
    "By regression over `health.ratio_time_s`, the speed by its encoder is not within 1 +- `health.ratio_share` of the "
    "commanded one. The robot takes a fix; repeated, it is a fault.",
    "Check gain and supply of the servo, the encoder's counts per turn, and the wheel radius in the firmware.")
WHEELS_STAND = hold("wheels_stand", Owner.DANGER, 60, Group.WHEELS, "both wheels stand, or no encoder counts",
    "They were commanded to turn. The motor supply or both encoders fail.",
    "Check the robot's supply and its own log.", retries=1, unit="m/s")
ENCODER_COUNTS_NOTHING = hold("encoder_counts_nothing", Owner.DANGER, 70, Group.WHEELS,
    "the {side} encoder counts nothing",
    "By the gyroscope the wheel turns, by its encoder it does not.", "Check the encoder's cable and disc.", retries=1)
WHEEL_BLOCKED = hold("wheel_blocked", Owner.DANGER, 80, Group.WHEELS, "the {side} wheel is blocked",
    "It was commanded to turn and stands still; the gyroscope agrees.", "Look for an obstacle.", retries=1)
WHEEL_CREEPS = hold("wheel_creeps", Owner.DANGER, 90, Group.WHEELS, "the {side} wheel turns while it is held",
    "The robot creeps. Fans to their maximum; a fault if it continues.", "Hold the robot; check fans, brake, slope.",
    full_fans=True)
WHEEL_CREEPS_ON = fault("wheel_creeps_on", Owner.DANGER, 100, Group.WHEELS, "the {side} wheel turns while it is held",
    "The robot has crept for a second. Fans to their maximum.",
    "Hold the robot; check fans, brake, slope.", full_fans=True)
WHEEL_DOES_NOT_STOP = hold("wheel_does_not_stop", Owner.DANGER, 110, Group.WHEELS,
    "the {side} wheel turns though it shall stand",
    "The servo does not come to rest.", "If it repeats, remove the robot: the servo fails.")
GRIP_LOST = hold("grip_lost", Owner.DANGER, 120, Group.WHEELS,
    "the robot loses its grip: it slides downhill over its wheels",
    "Accelerometer and gyroscope show a slide along gravity, its wheels do not. Wheels held, fans to their maximum; "
    "a fault if it slides again within `health.retry_window_s`.",
    "Tyres or mirror oily? Too little thrust for the slope: see `ccatp plan`.", full_fans=True, retries=0)
GRIP_TOO_LITTLE = fault("grip_too_little", Owner.DANGER, 130, Group.WHEELS,
    "too little grip by the creep of turns: the fans do not hold it everywhere",
    "The friction measured in turns, at the start and at each fix after a turn, is too small even for full thrust.",
    "Tyres or mirror oily? Clean them, or raise the thrust; `ccatp status` shows the friction. Wrong `robot.tyre_m`?",
    full_fans=True)
GRIP_LITTLE = slow("grip_little", Owner.DANGER, 140, Group.WHEELS,
    "little grip by the creep of turns: less than `robot.thrust_margin`",
    "The same, but full thrust still holds the robot. More thrust, half the speed.",
    "Tyres or mirror oily? Clean them, or raise the thrust. It ends when turns creep less.")
YAW_DISAGREES = hold("yaw_disagrees", Owner.DANGER, 150, Group.SENSORS,
    "gyroscope and wheels disagree about the turn: a wheel slips, or the gyroscope is off",
    "They disagree by more than slip and scale errors explain. The robot takes a fix.",
    "Wheels or mirror oily? Otherwise check the gyroscope.", unit="rad/s")

# -- fans -------------------------------------------------------------------------------------------------------------

FAN_TOO_LITTLE = fault("fan_too_little", Owner.DANGER, 160, Group.FANS, "the {side} fan gives too little",
    "Not enough to carry the robot with certainty. Wheels held, fans to their maximum.",
    "Secure the robot by hand before anything else.", full_fans=True)
FAN_WEAK = go_home("fan_weak", Owner.DANGER, 170, Group.FANS, "the {side} fan gets weak",
    "It gives less than commanded, but enough to carry the robot. The robot goes home.",
    "Replace it; `ccatp run --resume` later.", full_fans=True)
FAN_REPORTED = fault("fan_reported", Owner.DANGER, 180, Group.FANS, "the robot reports a fault of its {side} fan",
    "The robot reports it; handled like too little thrust.", "Secure the robot.", full_fans=True)
FAN_REPORTED_ON_THE_FLAT = inform("fan_reported_on_the_flat", Owner.DANGER, 190, Group.FANS,
    "the robot reports a fault of its {side} fan",
    "The same where the mirror does not overhang: the robot stands without fans.",
    "Replace it before the robot goes to an overhanging mirror.")

# -- link and clock ---------------------------------------------------------------------------------------------------

DRIVES_TOO_LATE = pause("drives_too_late", Owner.DANGER, 200, Group.LINK, "drives reach the wheels too late",
    "Commands take so long that the robot cannot be steered: a pause.", "Check the network.", unit="s")
DRIVES_LATE = slow("drives_late", Owner.DANGER, 210, Group.LINK, "drives reach the wheels late",
    "Commands take long. Half the speed.", "Check the network.", unit="s")
CLOCK_JUMPED = pause("clock_jumped", Owner.DANGER, 220, Group.LINK, "the robot's clock has jumped",
    "Its times are off by more than `health.clock_jump_s`. The clock's offset is measured again.",
    "Nothing, unless it repeats.", unit="s")
SAMPLES_MISDATED = inform("samples_misdated", Owner.DANGER, 230, Group.LINK,
    "samples of the {sensor} are {side} their frame: not used",
    "A sample is later than its frame by more than 1 ms, or older by more than 1 s, so its time is not known. What is "
    "not used is missing: see the alarms about samples that are stale.",
    "Check how the firmware stamps its samples. After a stall of the robot's computer nothing, unless it repeats.")
FRAMES_LOST = hold("frames_lost", Owner.DANGER, 240, Group.DATA, "frames were lost while the robot may have moved",
    "A gap in the frames while the robot moved. The robot takes a fix.", "If it repeats, check the network.", unit="s")
LINES_GARBLED = hold("lines_garbled", Owner.DANGER, 250, Group.DATA, "lines of the robot were no frames",
    "Several lines in a short time could not be read.",
    "Check network and firmware. `ccatp conformance` reports what is wrong in the robot's messages.")

# -- edge sensors and inertial unit -----------------------------------------------------------------------------------

EDGE_SENSOR_CHATTERS = hold("edge_sensor_chatters", Owner.DANGER, 260, Group.SENSORS, "an edge sensor chatters",
    "It changes many times a second where the map has no edge.", "Clean it; check its cable.", trusts_wheels=True,
    action=Action.LOCATE)
EDGE_SENSOR_FLASHES = pause("edge_sensor_flashes", Owner.DANGER, 270, Group.SENSORS,
    "an edge sensor went off though nothing moved",
    "Light fell on it, or it fails.", "Nothing, unless it repeats. Stray light: cover the place.", trusts_wheels=True,
    escalates_to=Action.LOCATE)
EDGE_SENSOR_STAYS_DARK = slow("edge_sensor_stays_dark", Owner.DANGER, 280, Group.SENSORS,
    "an edge sensor went off though nothing moved",
    "It stays off for longer than a pause may last: the edge rule decides, at half the speed.",
    "Clean or replace it. Stray light: cover the place.")
IMU_LEFT_OUT = slow("imu_left_out", Owner.DANGER, 290, Group.SENSORS, "{what}: left out",
    "Readings of the inertial unit are impossible (stuck, at their limit, a jump). It is not used: wheels alone, at "
    "half the speed.", "The accuracy is lower. Replace it if this does not end.")
ACCELEROMETER_DIFFERENCES = inform("accelerometer_differences", Owner.DANGER, 300, Group.SENSORS,
    "the accelerometer's samples are single differences, no means: they show contacts as motion",
    "More than twenty jumps in speed within about 20 s that the next sample does not take back. A slide counts with at "
    "most 2 m/s² and against the noise, so it is found later; the position is less accurate.",
    "The robot's firmware must send `ax` as a mean over at least the time between two samples.")
SAMPLES_TOO_FEW = slow("samples_too_few", Owner.DANGER, 310, Group.SENSORS, "a sensor gives too few samples",
    "One sensor is slower than usual. The robot continues at half its speed.", "See the robot's own log.")

# -- battery ----------------------------------------------------------------------------------------------------------

BATTERY_LOW = go_home("battery_low", Owner.DANGER, 320, Group.FANS, "the battery has to last for the way home",
    "The charge is enough for the way home with its reserve, but not for more. The robot goes home.",
    "Charge it; `ccatp run --resume` later.")
BATTERY_REPORTED = go_home("battery_reported", Owner.DANGER, 330, Group.FANS, "the robot reports a low battery",
    "The robot reports it, and goes home.", "Charge it; `ccatp run --resume` later.")

# -- seams ------------------------------------------------------------------------------------------------------------

EDGE_SENSOR_BLIND = hold("edge_sensor_blind", Owner.DANGER, 340, Group.SENSORS, "an edge sensor sees no seams: blind",
    "It would not detect the rim either.", "Clean or replace it before `ccatp resume`.", retries=0, trusts_wheels=True,
    action=Action.LOCATE)
SEAM_MISSED = slow("seam_missed", Owner.DANGER, 350, Group.SENSORS, "an edge sensor did not see a seam",
    "It crossed a seam without a signal. The robot continues at half its speed.",
    "Clean it; the second missed seam holds the robot.")

# -- what the robot reports of itself ---------------------------------------------------------------------------------

ENCODER_REPORTED = hold("encoder_reported", Owner.DANGER, 360, Group.WHEELS,
    "the robot reports a fault of its {side} encoder",
    "The robot reports it.", "See the robot's own log.")
EDGE_REPORTED = hold("edge_reported", Owner.DANGER, 370, Group.WHEELS, "the robot reports a fault of its edge sensors",
    "The robot reports it.", "See the robot's own log.")
STALL_REPORTED = hold("stall_reported", Owner.DANGER, 380, Group.WHEELS, "the robot reports that a wheel is blocked",
    "The robot reports it.", "Look for an obstacle.")
IMU_REPORTED = slow("imu_reported", Owner.DANGER, 390, Group.WHEELS, "the robot reports a fault of its inertial unit",
    "The robot reports it. Half the speed.", "See the robot's own log.")
UNKNOWN_REPORTED = inform("unknown_reported", Owner.DANGER, 400, Group.WHEELS,
    "the robot reports a fault that is not known here",
    "The firmware is newer than this program. It is only reported.", "See the robot's manual.")

# -- data that are missing or old -------------------------------------------------------------------------------------

NO_FRAME = pause("no_frame", Owner.DANGER, 410, Group.DATA, "no sensors frame",
    "The danger loop receives no frames from the robot.",
    "Is the robot on, the network up? See the link's alarms below.", unit="s")
NO_EDGE_SAMPLES = pause("no_edge_samples", Owner.DANGER, 420, Group.DATA, "no edge samples",
    "Frames arrive without edge samples.", "Check the robot's sensor board and its own log.", unit="s")
EDGE_STALE = pause("edge_stale", Owner.DANGER, 430, Group.DATA, "edge samples stale",
    "Frames arrive with old edge samples.", "Check the robot's sensor board and its own log.", unit="s")
ENCODERS_STALE = hold("encoders_stale", Owner.DANGER, 440, Group.DATA, "encoder samples stale",
    "No encoder samples arrive. Held until a fix, because the robot's motion is not known.",
    "Check the robot's encoders; if it repeats, remove the robot.", unit="s", trusts_wheels=True)
NO_ESTIMATE = pause("no_estimate", Owner.DANGER, 450, Group.DATA, "no estimate",
    "Main has not reported where the robot is: at the start, or while main is restarted.", "Nothing, unless it lasts.",
    unit="s")
ESTIMATE_STALE = pause("estimate_stale", Owner.DANGER, 460, Group.DATA, "estimate stale",
    "Main is too slow or hangs.",
    "Is something else busy on this machine? The supervisor restarts a main that hangs after two seconds.", unit="s")
ESTIMATE_NOT_FINITE = pause("estimate_not_finite", Owner.DANGER, 470, Group.DATA, "estimate not finite",
    "Main's estimate is not a number.", "Keep the run directory: this is a defect of ccatp.", unit="s")

# -- edges and emergencies --------------------------------------------------------------------------------------------

LIFTED = hold("lifted", Owner.DANGER, 480, Group.EDGES, "all edge sensors off: lifted or fallen",
    "All four edge sensors are off at once.",
    "Look at the robot before anything else. On an overhanging mirror the fans are at their maximum; do not cut their "
    "power. `ccatp resume` when it stands on the mirror again; it takes a fix first.",
    limit='health.lifted_limit_s', full_fans=True)
ALL_OFF = edge("all_off", Owner.DANGER, 490, Group.EDGES, "lifted or fallen",
    "All four edge sensors are off, in the first frame: code 1, no motion is permitted.",
    "Look at the robot before anything else; do not cut the power of its fans.", action=Action.WAIT, motion=Motion.NONE)
EDGE_SENSOR_STAYS_OFF = hold("edge_sensor_stays_off", Owner.DANGER, 500, Group.SENSORS,
    "an edge sensor stays off though it was moved back and the others are on",
    "The sensor fails, unless a fix, taken at once, shows a seam or the rim there: then the robot continues by itself.",
    "Clean or replace it. `ccatp resume` continues if it is on again.", action=Action.LOCATE, trusts_wheels=True)
RIM_AHEAD = edge("rim_ahead", Owner.DANGER, 510, Group.EDGES, "rim ahead on the map",
    "A sensor hangs over where the map has the rim.",
    "Nothing. If it repeats there: is the robot's pose plausible, is the base where the configuration has it?")
BEYOND_SEAM = edge("beyond_seam", Owner.DANGER, 520, Group.EDGES, "further off the panel than the seam is wide",
    "A sensor has been off over a longer way than the gap of the map there.",
    "Is a panel missing, or the gap wider than `mirror.panels.gap_mm`?")
NO_SEAM = edge("no_seam", Owner.DANGER, 530, Group.EDGES, "off the panel where the map has no seam",
    "A sensor went off in the middle of a panel: a hole, a dark spot, or a pose that is wrong.",
    "Look at the place. A dirty sensor does this everywhere, a wrong pose near seams.")
OFF_WITHOUT_WHEELS = edge("off_without_wheels", Owner.DANGER, 540, Group.EDGES,
    "off the panel while no encoder samples are received",
    "A sensor is off, and the distance that the robot has moved is not known.",
    "See the encoder's alarm.")
CENTRE_NEAR_RIM = edge("centre_near_rim", Owner.DANGER, 550, Group.EDGES,
    "the robot's centre is close to the rim on the map",
    "By its pose the robot is about to drive over the rim; no sensor has gone off yet.",
    "Is the pose plausible? If the robot is elsewhere: `ccatp stop`, carry it to base, remove `checkpoint`, "
    "`--resume`.", unit="m")
EARTHQUAKE = shaken("earthquake", Owner.DANGER, 560, Group.OBSERVATORY, "emergency: earthquake",
    "Held, fans at their maximum, until it is cleared; then home.",
    "Clear it when its cause is gone and the robot is at base or held.")
EMERGENCY = go_home("emergency", Owner.DANGER, 570, Group.OBSERVATORY, "emergency: {kind}",
    "Fire, power, weather or an operator's emergency: the robot goes home at once.",
    "Clear it when its cause is gone and the robot is at base or held.", action=Action.ABORT)


# == conditions that a mission, its localizer or the main loop finds ==================================================

BACK_OFFS = fault("back_offs", Owner.MISSION, ALONE, Group.EDGES,
    "at the edge again after {count} back-offs: is an edge sensor dirty?",
    "The way to the same point ends at an edge again and again.",
    "Clean the sensors, look at the place; `ccatp resume`, or abort.")
STUCK_AT_EDGE = hold("stuck_at_edge", Owner.MISSION, ALONE, Group.EDGES,
    "stuck at the edge: no motion away from it is permitted, or none helps",
    "The edge sensors bar every direction.",
    "Look at the robot. It tries again by itself as soon as a sensor is back on.",
    action=Action.WAIT, clear=Clear.AUTO)

NO_FRAME_FOR = wait("no_frame_for", Owner.MAIN, ALONE, Group.DATA, "no sensors frame for {age_s:.2f} s",
    "The main loop receives no frames from the robot.", "Is the robot on, the network up?")
NO_VERDICT = pause("no_verdict", Owner.MAIN, ALONE, Group.DATA, "no fresh verdict from the danger loop",
    "The danger loop is too slow, hangs, or is being restarted.",
    "Is something else busy on this machine? The supervisor restarts a danger loop that hangs.")
FRAME_LATE = pause("frame_late", Owner.MAIN, ALONE, Group.DATA,
    "a frame was served {late_ms:.0f} ms late (limit {limit_ms:.0f} ms)",
    "This machine was too slow for one frame.",
    "Nothing, unless it repeats: other programs, or no real-time rights (`no real time` in `log.jsonl`).")
FRAMES_OLD = pause("frames_old", Owner.MAIN, ALONE, Group.DATA,
    "frames are {late_ms:.0f} ms old (limit {limit_ms:.0f} ms)",
    "By the robot's echo of the drives, frames or drives are delayed by this time in the network or a queue.",
    "Check the network and the load of the robot's computer.")

UNATTENDED_FAULT = go_home("unattended_fault", Owner.MISSION, ALONE, Group.FANS,
    "unattended fault: the battery ({charge:.0%}) lasts for little more than the way home",
    "Held on an overhanging mirror, and no operator has reacted: it goes home by itself, once.",
    "Attend to held robots; a fault is reported every minute.")
FANS_REFUSED = fault("fans_refused", Owner.MISSION, ALONE, Group.FANS, "fan command refused: {why}; set robot.fan_duty",
    "The robot would fall with the configured duty of its fans.", "Correct the configuration; start again.")

LINK_LOST = wait("link_lost", Owner.LINK, ALONE, Group.LINK, "robot link lost: {reason}",
    "The connection ended. The robot holds its wheels by itself; main reconnects for `robot.reconnect_timeout_s`.",
    "Check network and robot. After that time the run ends with status 5; `--resume` continues it.",
    clear=Clear.AFTER_FIX)
FRAMES_BACKWARD = diverged("frames_backward", Owner.LOCALIZER, ALONE, Group.LINK,
    "time stamps of the frames run backward",
    "Five in a row. The robot is held; repeated more than `health.retries` times, it is a fault.",
    "Check the clock of the firmware.")
SENSOR_BACKWARD = diverged("sensor_backward", Owner.LOCALIZER, ALONE, Group.LINK,
    "time stamps of the {sensor} run backward",
    "The same for one sensor, likewise a fault if it repeats.", "Check the clock of the firmware.")

LEG_OVERDUE = fault("leg_overdue", Owner.MISSION, ALONE, Group.SURVEY,
    "the leg to ({x_m:.3f}, {y_m:.3f}) m is overdue: is a wheel blocked or slipping?",
    "It takes many times longer than it should.", "Look at the robot.")
NO_REST = fault("no_rest", Owner.MISSION, ALONE, Group.SURVEY,
    "the robot does not come to rest: {v_m_s:.4f} m/s, {omega_rad_s:.4f} rad/s",
    "It should stand at a point, but moves.", "Shaking fans, or a slippery slope?")
NO_WAY_ON = fault("no_way_on", Owner.MISSION, ALONE, Group.SURVEY, "no way on: {why}",
    "From where it stands no safe way leads to the next point.",
    "`ccatp abort`; if there is no way home either, carry it.")
NO_WAY_HOME = fault("no_way_home", Owner.MISSION, ALONE, Group.SURVEY, "no way home: {why}",
    "From where it stands no safe way leads to base.", "Carry it to base.")
TIME_USED_UP = go_home("time_used_up", Owner.MISSION, ALONE, Group.SURVEY,
    "the time budget of {budget_s:g} s is used up",
    "The way home would use the rest of it.", "Nothing; `ccatp run --resume` measures the remaining points.")
MEASUREMENTS_FAILED = fault("measurements_failed", Owner.MISSION, ALONE, Group.SURVEY,
    "{count} measurements in a row failed: {why}",
    "The laser system does not see the puck; the reason is after the colon.",
    "Check laser, line of sight and cleanliness of the puck; `ccatp resume`.")
NOT_FOUND = fault("not_found", Owner.MISSION, ALONE, Group.SURVEY, "the robot cannot be found again: {why}",
    "Its pose is not trusted, and no fix determines its place.", "Check laser and line of sight; `ccatp resume`.")
FRAME_REFUSED = fault("frame_refused", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system sees the robot {distance_m:.2f} m from {place}: {why}",
    "A fix at the start or on the way lies where the robot cannot be: the laser system has another frame.",
    "Check the configured collimators, base and start of the robot.")
LASER_NOT_READY = wait("laser_not_ready", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system is not ready (laserready_0)",
    "Its lasers are not warm. The robot waits at its point; no point is skipped.",
    "Wait, or look at the laser unit; `ccatp check` shows it as well.")
LASER_NOT_FOLLOWING = fault("laser_not_following", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser does not follow the robot: its fixes of {count} standstills agree, and encoders and gyroscope moved",
    "The lengths are those of one place (with noise) while wheels and gyroscope show motion: the laser measures "
    "another reflector or delivers old lengths. None of these fixes is used.",
    "Point the beams at the puck or restart the laser's driver; then `ccatp resume`: it takes a fix. `ccatp abort` "
    "sends the robot home by odometry.")
METROLOGY_UNRELIABLE = inform("metrology_unreliable", Owner.FIXES, ALONE, Group.SURVEY,
    "the lengths of {count} points in a row contradict each other: channels {channels}",
    "The fixes navigate the robot, but are no measurement of the panels: these points are marked unreliable.",
    "Check the beams, the reflector and the air data of the laser system. Measure the points again.")
LENGTHS_REFUSED = fault("lengths_refused", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system's lengths do not lead to the robot's base: {why}",
    "The lengths of the first fix give no position.", "Check the configured collimators and base.")
FILTER_DIVERGED = diverged("filter_diverged", Owner.LOCALIZER, ALONE, Group.SURVEY, "filter: {why}",
    "The estimate is not a valid Gaussian any more. The pose is frozen until the next fix; a fault if it repeats.",
    "If it repeats, keep the run directory.")

FIX_NOT_STORED = fault("fix_not_stored", Owner.FIXES, ALONE, Group.STORAGE,
    "the fix of {point} cannot be stored: {why}",
    "The disk is full or broken, or another program locks the database.",
    "Make room, or end that program; `ccatp resume` measures the point again. Once a write has failed nothing more is "
    "written: `ccatp stop`, then `ccatp run --resume`.")
SKIP_NOT_STORED = fault("skip_not_stored", Owner.FIXES, ALONE, Group.STORAGE,
    "that {point} is skipped cannot be stored: {why}",
    "The disk is full or broken, or another program locks the database.",
    "Make room, or end that program; then `ccatp stop` and `ccatp run --resume`.")
DISK_STALLS = fault("disk_stalls", Owner.FIXES, ALONE, Group.STORAGE,
    "the disk stalls: {point} is not stored after {time_s:g} s",
    "The disk does not answer.", "Check the disk; then `ccatp resume`.")

RESTARTED = fault("restarted", Owner.OPERATOR, ALONE, Group.OBSERVATORY,
    "{before}restarted: {done} points are measured and will be skipped, {left} are to do; 'ccatp resume' {goes_on}",
    "A run was started again and waits for an operator.", "`ccatp resume` continues it.")
OPERATOR = go_home("operator", Owner.OPERATOR, ALONE, Group.OBSERVATORY, "operator",
    "An operator called the robot home, or paused it: then it is held.",
    "`ccatp resume` after a pause; otherwise nothing, a new survey measures the remaining points.", action=Action.ABORT)
# fmt: on


def text_of(cause: Cause) -> str:
    """The text of a cause for people; a cause without a row here, of a newer version, is shown by its name."""
    if not cause:
        return ""
    row = find_condition(cause.condition)
    try:
        text = cause.condition if row is None else row.message.format(**cause.values)
    except (KeyError, ValueError, IndexError):  # the values are of another version
        row, text = None, cause.condition
    if row is None and cause.values:
        text += f" ({', '.join(f'{name} {value}' for name, value in cause.values.items())})"
    text += f", for {cause.lasted_s:g} s" if cause.lasted_s else ""
    text += f", on repetition {cause.repetition}" if cause.repetition else ""
    return text if cause.besides is None else f"{text}; {text_of(cause.besides)}"


def danger_text(condition: str, cause: str, signal: str, value: float, limit: float) -> str:
    """Like ``estimate stale: 0.31 s (limit 0.15 s)``; without a limit of 0 or a signal that ``cause`` names."""
    named, row = signal.replace("_", " "), find_condition(condition)
    is_named = not named or named in cause or (row is not None and row.group == Group.OBSERVATORY)
    where = "" if is_named else f" ({named})"
    if not limit:
        return cause + where
    shown, bound = (f"{number:.4g} {row.unit if row else ''}".rstrip() for number in (value, limit))
    # A signal that was never received has its age set to the limit.
    return f"{cause}{where}: " + (f"limit {bound}" if shown == bound else f"{shown} (limit {bound})")
