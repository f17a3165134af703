"""Rows of the table of conditions that the danger loop of a survey, or of any mission, finds."""

from typing import NamedTuple

from ccatp.conditions import (
    Action,
    Actor,
    Group,
    Motion,
    Owner,
    edge,
    fault,
    go_home,
    hold,
    inform,
    pause,
    shaken,
    slow,
)


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
    trusts_wheels=True, unit="Hz", then="set the sensor's rate in the robot's firmware")
SENSOR_TOO_SLOW = slow("sensor_too_slow", Owner.DANGER, 20, Group.SENSORS, _RATE,
    "The sample rate is lower than needed at full speed. The robot continues at half its speed.", _FIRMWARE, unit="Hz")

# -- wheels and encoders ----------------------------------------------------------------------------------------------

ENCODER_BROKEN = hold("encoder_broken", Owner.DANGER, 30, Group.WHEELS, "the {side} encoder {what}",
    "One encoder repeats itself, or gives no values, while the wheel must turn. The robot takes a fix and continues; "
    "repeated, it is a fault.", "Check its cable.", unit="m/s", then="check the encoder's cable")
WHEEL_RUNS_AWAY = hold("wheel_runs_away", Owner.DANGER, 40, Group.WHEELS, "the {side} wheel runs away",
    "It turns faster than commanded.", "Remove the robot: the servo fails.",
    actor=Actor.OPERATOR, unit="m/s", then="remove the robot: its servo fails")
WHEEL_SPEED_WRONG = hold("wheel_speed_wrong", Owner.DANGER, 50, Group.WHEELS,
    "the {side} wheel turns {ratio} times as fast as commanded",
    "By regression over `health.ratio_time_s`, the speed by its encoder is not within 1 +- `health.ratio_share` of the "
    "commanded one. The robot takes a fix; repeated, it is a fault.",
    "Check gain and supply of the servo, the encoder's counts per turn, and the wheel radius in the firmware.",
    then="check the servo's supply and the encoder")
WHEELS_STAND = hold("wheels_stand", Owner.DANGER, 60, Group.WHEELS, "both wheels stand, or no encoder counts",
    "They were commanded to turn. The motor supply or both encoders fail.",
    "Check the robot's supply and its own log.", retries=1, unit="m/s",
    then="check the supply of the robot's motors and its own log")
ENCODER_COUNTS_NOTHING = hold("encoder_counts_nothing", Owner.DANGER, 70, Group.WHEELS,
    "the {side} encoder counts nothing",
    "By the gyroscope the wheel turns, by its encoder it does not.", "Check the encoder's cable and disc.", retries=1,
    unit="m/s", then="check the encoder's cable and disc")
WHEEL_BLOCKED = hold("wheel_blocked", Owner.DANGER, 80, Group.WHEELS, "the {side} wheel is blocked",
    "It was commanded to turn and stands still; the gyroscope agrees.", "Look for an obstacle.", retries=1,
    unit="m/s", then="look for an obstacle at the wheel")
WHEEL_CREEPS = hold("wheel_creeps", Owner.DANGER, 90, Group.WHEELS, "the {side} wheel turns while it is held",
    "The robot creeps. Fans to their maximum; a fault if it continues.", "Hold the robot; check fans, brake, slope.",
    full_fans=True, unit="m", then="hold the robot by hand; check fans, brake and slope")
WHEEL_CREEPS_ON = fault("wheel_creeps_on", Owner.DANGER, 100, Group.WHEELS, "the {side} wheel turns while it is held",
    "The robot has crept for a second. Fans to their maximum.",
    "Hold the robot; check fans, brake, slope.", full_fans=True,
    unit="m", then="hold the robot by hand; check fans, brake and slope")
WHEEL_DOES_NOT_STOP = hold("wheel_does_not_stop", Owner.DANGER, 110, Group.WHEELS,
    "the {side} wheel turns though it shall stand",
    "The servo does not come to rest.", "If it repeats, remove the robot: the servo fails.",
    unit="m/s", then="remove the robot: its servo fails")
GRIP_LOST = hold("grip_lost", Owner.DANGER, 120, Group.WHEELS,
    "the robot loses its grip: it slides downhill over its wheels",
    "Accelerometer and gyroscope show a slide along gravity, its wheels do not. Wheels held, fans to their maximum; "
    "a fault if it slides again within `health.retry_window_s`.",
    "Tyres or mirror oily? Too little thrust for the slope: see `ccatp plan`.", full_fans=True, retries=0,
    unit="m/s", then="secure the robot by hand; clean tyres and mirror")
GRIP_TOO_LITTLE = fault("grip_too_little", Owner.DANGER, 130, Group.WHEELS,
    "too little grip by the creep of turns: the fans do not hold it everywhere",
    "The friction measured in turns, at the start and at each fix after a turn, is too small even for full thrust.",
    "Tyres or mirror oily? Clean them, or raise the thrust; `ccatp status` shows the friction. Wrong `robot.tyre_m`?",
    full_fans=True, then="secure the robot by hand; clean the tyres, or raise the thrust")
GRIP_LITTLE = slow("grip_little", Owner.DANGER, 140, Group.WHEELS,
    "little grip by the creep of turns: less than `robot.thrust_margin`",
    "The same, but full thrust still holds the robot. More thrust, half the speed.",
    "Tyres or mirror oily? Clean them, or raise the thrust. It ends when turns creep less.")
YAW_DISAGREES = hold("yaw_disagrees", Owner.DANGER, 150, Group.SENSORS,
    "gyroscope and wheels disagree about the turn: a wheel slips, or the gyroscope is off",
    "They disagree by more than slip and scale errors explain. The robot takes a fix.",
    "Wheels or mirror oily? Otherwise check the gyroscope.", unit="rad",
    then="check the gyroscope; clean wheels and mirror")
TURN_TIMES_DIFFER = hold("turn_times_differ", Owner.DANGER, 155, Group.SENSORS,
    "by their time stamps the gyroscope shows turns at least {ms} ms {side} than the encoders",
    "By regression over the last turns; one of the two has wrong time stamps, so that the heading is wrong whenever a "
    "turn begins or ends. The robot takes a fix.",
    "Each sample needs the time at which it was taken: check how the robot stamps both, and filters in the sensors.",
    unit="s", then="check how the robot stamps the samples of gyroscope and encoders")

# -- fans -------------------------------------------------------------------------------------------------------------

FAN_TOO_LITTLE = fault("fan_too_little", Owner.DANGER, 160, Group.FANS, "the {side} fan gives too little",
    "Not enough to carry the robot with certainty. Wheels held, fans to their maximum.",
    "Secure the robot by hand before anything else.", full_fans=True, then="secure the robot by hand")
FAN_WEAK = go_home("fan_weak", Owner.DANGER, 170, Group.FANS, "the {side} fan gets weak",
    "It gives less than commanded, but enough to carry the robot. The robot goes home.",
    "Replace it; `ccatp run --resume` later.", full_fans=True, then="replace the fan before the next survey")
FAN_REPORTED = fault("fan_reported", Owner.DANGER, 180, Group.FANS, "the robot reports a fault of its {side} fan",
    "The robot reports it; handled like too little thrust.", "Secure the robot.", full_fans=True,
    then="secure the robot by hand")
FAN_REPORTED_ON_THE_FLAT = inform("fan_reported_on_the_flat", Owner.DANGER, 190, Group.FANS,
    "the robot reports a fault of its {side} fan",
    "The same where the mirror does not overhang: the robot stands without fans.",
    "Replace it before the robot goes to an overhanging mirror.")

# -- link and clock ---------------------------------------------------------------------------------------------------

DRIVES_TOO_LATE = pause("drives_too_late", Owner.DANGER, 200, Group.LINK, "drives reach the wheels too late",
    "Commands take so long that the robot cannot be steered: a pause.", "Check the network.", unit="s",
    then="check the network")
DRIVES_LATE = slow("drives_late", Owner.DANGER, 210, Group.LINK, "drives reach the wheels late",
    "Commands take long. Half the speed.", "Check the network.", unit="s")
CLOCK_JUMPED = pause("clock_jumped", Owner.DANGER, 220, Group.LINK, "the robot's clock has jumped",
    "Its times are off by more than `health.clock_jump_s`. The clock's offset is measured again.",
    "Nothing, unless it repeats.", unit="s", then="check the robot's clock")
SAMPLES_MISDATED = inform("samples_misdated", Owner.DANGER, 230, Group.LINK,
    "samples of the {sensor} are {side} their frame: not used",
    "A sample is later than its frame by more than 1 ms, or older by more than 1 s, so its time is not known. What is "
    "not used is missing: see the alarms about samples that are stale.",
    "Check how the firmware stamps its samples. After a stall of the robot's computer nothing, unless it repeats.",
    unit="s")
FRAMES_LOST = hold("frames_lost", Owner.DANGER, 240, Group.DATA, "frames were lost while the robot may have moved",
    "A gap in the frames while the robot moved. The robot takes a fix.", "If it repeats, check the network.", unit="s",
    then="check the network")
LINES_GARBLED = hold("lines_garbled", Owner.DANGER, 250, Group.DATA, "lines of the robot were no frames",
    "Several lines in a short time could not be read.",
    "Check network and firmware. `ccatp conformance` reports what is wrong in the robot's messages.",
    then="check the network and the robot's firmware")

# -- edge sensors and inertial unit -----------------------------------------------------------------------------------

EDGE_SENSOR_CHATTERS = hold("edge_sensor_chatters", Owner.DANGER, 260, Group.SENSORS, "an edge sensor chatters",
    "It changes many times a second where the map has no edge.", "Clean it; check its cable.", trusts_wheels=True,
    action=Action.LOCATE, then="clean the edge sensor; check its cable")
EDGE_SENSOR_FLASHES = pause("edge_sensor_flashes", Owner.DANGER, 270, Group.SENSORS,
    "an edge sensor went off though nothing moved",
    "Light fell on it, or it fails.", "Nothing, unless it repeats. Stray light: cover the place.", trusts_wheels=True,
    escalates_to=Action.LOCATE, then="clean the edge sensor, or cover the place from stray light")
EDGE_SENSOR_STAYS_DARK = slow("edge_sensor_stays_dark", Owner.DANGER, 280, Group.SENSORS,
    "an edge sensor went off though nothing moved",
    "It stays off for longer than a pause may last: the edge rule decides, at half the speed.",
    "Clean or replace it. Stray light: cover the place.")
IMU_LEFT_OUT = slow("imu_left_out", Owner.DANGER, 290, Group.SENSORS, "{what}: not used",
    "Readings of the inertial unit are impossible (stuck, at their limit, a jump), or arrive late. It is not used: "
    "wheels alone, at half the speed.", "The accuracy is lower. Replace it if this does not end.")
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
    "Charge it; `ccatp run --resume` later.", then="charge the battery before the next survey")
BATTERY_REPORTED = go_home("battery_reported", Owner.DANGER, 330, Group.FANS, "the robot reports a low battery",
    "The robot reports it, and goes home.", "Charge it; `ccatp run --resume` later.",
    then="charge the battery before the next survey")

# -- seams ------------------------------------------------------------------------------------------------------------

EDGE_SENSOR_BLIND = hold("edge_sensor_blind", Owner.DANGER, 340, Group.SENSORS,
    "an edge sensor detects no seams: blind",
    "It would not detect the rim either.", "Clean or replace it before `ccatp resume`.", retries=0, trusts_wheels=True,
    action=Action.LOCATE, then="clean or replace the edge sensor")
SEAM_MISSED = slow("seam_missed", Owner.DANGER, 350, Group.SENSORS, "an edge sensor did not see a seam",
    "It crossed a seam without a signal. The robot continues at half its speed.",
    "Clean it; the second missed seam holds the robot.")

# -- what the robot reports of itself ---------------------------------------------------------------------------------

ENCODER_REPORTED = hold("encoder_reported", Owner.DANGER, 360, Group.WHEELS,
    "the robot reports a fault of its {side} encoder",
    "The robot reports it.", "See the robot's own log.", then="look into the robot's own log")
EDGE_REPORTED = hold("edge_reported", Owner.DANGER, 370, Group.WHEELS, "the robot reports a fault of its edge sensors",
    "The robot reports it.", "See the robot's own log.", then="look into the robot's own log")
STALL_REPORTED = hold("stall_reported", Owner.DANGER, 380, Group.WHEELS, "the robot reports that a wheel is blocked",
    "The robot reports it.", "Look for an obstacle.", then="look for an obstacle at the wheel")
IMU_REPORTED = slow("imu_reported", Owner.DANGER, 390, Group.WHEELS, "the robot reports a fault of its inertial unit",
    "The robot reports it. Half the speed.", "See the robot's own log.")
UNKNOWN_REPORTED = inform("unknown_reported", Owner.DANGER, 400, Group.WHEELS,
    "the robot reports a fault that is not known here",
    "The firmware is newer than this program. It is only reported.", "See the robot's manual.")

# -- data that are missing or old -------------------------------------------------------------------------------------

NO_FRAME = pause("no_frame", Owner.DANGER, 410, Group.DATA, "no sensors frame",
    "The danger loop receives no frames from the robot.",
    "Is the robot on, the network up? See the link's alarms below.", unit="s",
    then="switch the robot on, check the network")
NO_EDGE_SAMPLES = pause("no_edge_samples", Owner.DANGER, 420, Group.DATA, "no edge samples",
    "Frames arrive without edge samples.", "Check the robot's sensor board and its own log.", unit="s",
    then="check the robot's sensor board and its own log")
EDGE_STALE = pause("edge_stale", Owner.DANGER, 430, Group.DATA, "edge samples stale",
    "Frames arrive with old edge samples.", "Check the robot's sensor board and its own log.", unit="s",
    then="check the robot's sensor board and its own log")
ENCODERS_STALE = hold("encoders_stale", Owner.DANGER, 440, Group.DATA, "encoder samples stale",
    "No encoder samples arrive. Held until a fix, because the robot's motion is not known.",
    "Check the robot's encoders; if it repeats, remove the robot.", unit="s", trusts_wheels=True,
    then="check the robot's encoders")
NO_ESTIMATE = pause("no_estimate", Owner.DANGER, 450, Group.DATA, "no estimate",
    "Main has not reported where the robot is: at the start, or while main is restarted.", "Nothing, unless it lasts.",
    unit="s", then="look into log.jsonl: main does not report")
ESTIMATE_STALE = pause("estimate_stale", Owner.DANGER, 460, Group.DATA, "estimate stale",
    "Main is too slow or hangs.",
    "Is something else busy on this machine? The supervisor restarts a main that hangs after two seconds.", unit="s",
    then="end what else is busy on this machine")
ESTIMATE_NOT_FINITE = pause("estimate_not_finite", Owner.DANGER, 470, Group.DATA, "estimate not finite",
    "Main's estimate is not a number.", "Keep the run directory: this is a defect of ccatp.", unit="s",
    then="keep the run directory, and report the defect")

# -- edges and emergencies --------------------------------------------------------------------------------------------

LIFTED = hold("lifted", Owner.DANGER, 480, Group.EDGES, "all edge sensors off: lifted or fallen",
    "All four edge sensors are off at once.",
    "Look at the robot before anything else. On an overhanging mirror the fans are at their maximum; do not cut their "
    "power. `ccatp resume` when it stands on the mirror again; it takes a fix first.",
    limit='health.lifted_limit_s', full_fans=True,
    actor=Actor.OPERATOR, then="put the robot back on the mirror; do not cut the power of its fans")
ALL_OFF = edge("all_off", Owner.DANGER, 490, Group.EDGES, "lifted or fallen",
    "All four edge sensors are off, in the first frame: code 1, no motion is permitted.",
    "Look at the robot before anything else; do not cut the power of its fans.", action=Action.WAIT, motion=Motion.NONE,
    actor=Actor.OPERATOR, then="put the robot back on the mirror; do not cut the power of its fans")
EDGE_SENSOR_STAYS_OFF = hold("edge_sensor_stays_off", Owner.DANGER, 500, Group.SENSORS,
    "an edge sensor stays off though it was moved back and the others are on",
    "The sensor fails, unless a fix, taken at once, shows a seam or the rim there: then the robot continues by itself.",
    "Clean or replace it. `ccatp resume` continues if it is on again.", action=Action.LOCATE, trusts_wheels=True,
    actor=Actor.OPERATOR, unit="m", then="clean or replace the edge sensor")
RIM_AHEAD = edge("rim_ahead", Owner.DANGER, 510, Group.EDGES, "rim ahead on the map",
    "A sensor hangs over where the map has the rim.",
    "Nothing. If it repeats there: is the robot's pose plausible, is the base where the configuration has it?",
    unit="m", then="look at the robot's place on the mirror")
BEYOND_SEAM = edge("beyond_seam", Owner.DANGER, 520, Group.EDGES, "further off the panel than the seam is wide",
    "A sensor has been off over a longer way than the gap of the map there.",
    "Is a panel missing, or the gap wider than `mirror.panels.gap_mm`?", unit="m",
    then="look whether a panel is missing there")
NO_SEAM = edge("no_seam", Owner.DANGER, 530, Group.EDGES, "off the panel where the map has no seam",
    "A sensor went off in the middle of a panel: a hole, a dark spot, or a pose that is wrong.",
    "Look at the place. A dirty sensor does this everywhere, a wrong pose near seams.",
    unit="m", then="look at the place, and at the edge sensor")
OFF_WITHOUT_WHEELS = edge("off_without_wheels", Owner.DANGER, 540, Group.EDGES,
    "off the panel while no encoder samples are received",
    "A sensor is off, and the distance that the robot has moved is not known.",
    "See the encoder's alarm.", unit="m", then="check the robot's encoders")
CENTRE_NEAR_RIM = edge("centre_near_rim", Owner.DANGER, 550, Group.EDGES,
    "the robot's centre is close to the rim on the map",
    "By its pose the robot is about to drive over the rim; no sensor has gone off yet.",
    "Is the pose plausible? If the robot is elsewhere: `ccatp stop`, carry it to base, remove `checkpoint`, "
    "`--resume`.", unit="m", then="look at the robot's place on the mirror")
EARTHQUAKE = shaken("earthquake", Owner.DANGER, 560, Group.OBSERVATORY, "emergency: earthquake",
    "Held, fans at their maximum, until it is cleared; then home.",
    "Clear it when its cause is gone and the robot is at base or held.",
    then="clear the emergency when the earthquake is over")
EMERGENCY = go_home("emergency", Owner.DANGER, 570, Group.OBSERVATORY, "emergency: {kind}",
    "Fire, power, weather or an operator's emergency: the robot goes home at once.",
    "Clear it when its cause is gone and the robot is at base or held.", action=Action.ABORT,
    actor=Actor.OBSERVATORY, then="clear the emergency when its cause is gone")
# fmt: on
