"""The robot among beacons on its own computer: commands to its base, readings to frames. Time is an argument.

``ccatp.onboard.rules`` contains the rules of the link. In addition, the wheels are held while

* the base or one of its sonars sends nothing, until it works again;
* a wheel is stalled or a bumper pressed, until the set points of the rules are zero;
* the control loop ran so late that the base's own watchdog may have stopped the wheels, for that step;
* a scan is due, until it has ended or was interrupted: the robot stands while it listens.

A drive with a steering angle is refused: the two driven wheels cannot follow it.
"""

from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from ccatp.beacons.links.messages import BeaconFrame, MoteBurst, with_extras
from ccatp.beacons.onboard.hardware import BeaconHardware
from ccatp.beacons.onboard.pioneer import WheelSpeeds
from ccatp.beacons.onboard.scanner import ScanResult
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import RobotData, VehicleData
from ccatp.onboard.controlled import ControlledRobot
from ccatp.onboard.hardware import HardwareError
from ccatp.onboard.rules import HELD

# Without these the robot does not move; distance sensors are reported as edge sensors.
NEEDED = ("encoder_right", "encoder_left", "edge", "stall")
_ON_LINK = (*NEEDED, "battery_low")
_CORNER = (0.0, 0.0)  # reported place of the edge sensors, which it does not have
# Pulses in a line: with the longest names three quarters of the line's limit, and beside a scan one quarter.
_LINE_PULSES, _LINE_PULSES_OF_SCANS = 100, 35
_LATE_STEPS = 5  # of the control loop, after which nobody knows when a pulse came
_NOTHING = ScanResult(None, [])


class BeaconOnboardRobot(ControlledRobot):
    """The robot; ``hardware`` has been started.

    Attributes:
        scans_due: the robot stands, or is about to, for a scan.
    """

    def __init__(self, cfg: BeaconOnboardConfig, hardware: BeaconHardware) -> None:
        link, body = cfg.link, cfg.robot
        super().__init__((link.ttl_s, body.max_wheel_rad_s, 0.0), link.frame_hz, link.sample_latency_s)
        self._cfg, self._hardware = cfg, hardware
        self.loop_hz = body.loop_hz
        self._control_s: float | None = None
        self._driven_s = 0.0  # since the newest scan
        self._stands, self._stands_since_s = hardware.base is None, 0.0  # the wheels, since when
        self._stall, self._soc = "", 1.0
        self._line_pulses = _LINE_PULSES if hardware.scanner is None else _LINE_PULSES_OF_SCANS
        self.scans_due = False
        # What is not in a frame yet.
        self._enc: list[WheelSpeeds] = []
        self._motes: list[MoteBurst] = []
        self._distances_m: list[float] = []
        self._scanned = _NOTHING

    def describe(self) -> RobotData:
        body, base = self._cfg.robot, self._cfg.devices.base
        return RobotData(
            wheel_radius_m=body.wheel_radius_m,
            wheel_base_m=body.track_m,
            edge_sensors_m=(_CORNER, _CORNER, _CORNER, _CORNER),
            puck_m=(0.0, 0.0, 0.0),
            max_wheel_rad_s=body.max_wheel_rad_s,
            fan_floor=0.0,
            vehicle=VehicleData(
                kind="differential",
                axle_distance_m=body.axle_distance_m,
                steer_max_rad=0.0,
                distance_sensors_rad=list(base.sonars_rad) if base.is_used else [],
            ),
        )

    def drive(
        self,
        seq: int,
        right_rad_s: float,
        left_rad_s: float,
        now_s: float | None = None,
        steer_rad: float | None = None,
    ) -> bool:
        """Take a drive; false also for one with a steering angle, which then expires as any other."""
        return not steer_rad and super().drive(seq, right_rad_s, left_rad_s, now_s)

    # -- the wheels ---------------------------------------------------------------------------------------------------

    def control(self, now_s: float) -> None:
        """Read the devices and set the speeds of the wheels, at ``now_s`` of the robot's clock."""
        last_s, self._control_s = self._control_s, now_s
        dt_s = 1.0 / self.loop_hz if last_s is None else now_s - last_s
        readings = self._hardware.read(now_s)
        self.faults = dict(readings.faults)
        self._soc = readings.soc
        self._enc += readings.wheels
        if dt_s * self.loop_hz <= _LATE_STEPS:
            self._motes += readings.motes
        else:
            self.dropped_samples += len(readings.motes)
        self._distances_m = readings.distances_m or []
        right, left = self.rules.set_points(now_s)
        is_late = dt_s > self._cfg.devices.base.most_watchdog_s
        self.late_steps += is_late
        self._stall = readings.stall or (self._stall if right or left else "")
        if self._stall:
            self.faults["stall"] = self._stall
        self._scan(readings.wheels, now_s, dt_s)
        if is_late or self.scans_due or any(name in self.faults for name in NEEDED) or self._hardware.base is None:
            right, left = HELD
            self.rules.is_held = True
        try:
            self._hardware.drive(right, left, now_s)
        except HardwareError as error:
            self.faults["encoder_right"] = self.faults["encoder_left"] = str(error)
            self.rules.is_held = True

    def _scan(self, wheels: list[WheelSpeeds], now_s: float, dt_s: float) -> None:
        """Begin a scan when one is due and the robot stands; interrupt it if the robot moves."""
        scanner, times = self._hardware.scanner, self._cfg.scan
        if scanner is None or not times.every_s:
            return
        self._watch_wheels(wheels, now_s)
        if scanner.is_scanning:
            if not self._stands:
                scanner.interrupt("the robot moved")
            elif "encoder_right" in self.faults:
                scanner.interrupt("the base sends nothing: the robot may move")
        if (result := scanner.take()) is not None:
            self._scanned = result
        if not self.scans_due:
            self._driven_s += dt_s
            self.scans_due = self._driven_s >= times.every_s and scanner.is_ready
        elif not scanner.is_scanning:
            if self._driven_s == 0.0 or not scanner.is_ready:  # it has ended, or cannot begin
                self.scans_due, self._driven_s = False, 0.0
            elif self._stands and now_s - self._stands_since_s >= times.standing_s:
                scanner.begin()
                self._driven_s = 0.0

    def _watch_wheels(self, wheels: list[WheelSpeeds], now_s: float) -> None:
        for _, *rates in wheels:
            stands = all(rate is not None and abs(rate) <= self._cfg.scan.standing_rad_s for rate in rates)
            if stands and not self._stands:
                self._stands_since_s = now_s
            self._stands = stands

    # -- frames -------------------------------------------------------------------------------------------------------

    def _close_frame(self, t_s: float) -> None:
        since_s, self.t_s = self.t_s, t_s
        frame = RobotFrame(
            self.seq,
            round(t_s, 6),
            imu=(),
            enc=self._take_samples(self._enc, since_s),
            edge=(),
            gravity=None,
            fans=self.fans.duty,
            soc=self._soc,
            cmd=self._echo(t_s),
            faults=tuple(name for name in sorted(self.faults) if name in _ON_LINK),
        )
        (scan, radio), self._scanned = self._scanned, _NOTHING
        extras = BeaconFrame(
            radio=radio,
            scan=scan,
            distances=[round(distance_m, 3) for distance_m in self._distances_m],
            motes=self._take_samples(self._motes, since_s, self._line_pulses),
        )
        self._line = with_extras(encode(frame), extras)
        self.delivered_seq = self.seq
