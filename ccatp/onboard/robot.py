"""The robot on its own computer: converts commands to motor voltages and samples to frames. Time is an argument.

``control`` runs the wheels, ``servo.loop_hz`` times a second; ``advance`` closes a frame. ``ccatp.onboard.rules``
contains the rules of the link. In addition, the wheels are held while

* a device that is needed to drive has failed (inertial unit, encoders, edge sensors), until it works again;
* a wheel is stalled, until the set points of the rules are zero;
* the control loop ran so late that the external timer may have braked, for that step;
* the robot slides over its wheels, and for half a second after: then the fans run at full duty until the next fan
  command.

Otherwise only fan commands change the fans.
"""

from math import inf, pi

from ccatp.config.onboard_models import EdgeThresholdConfig, OnboardConfig
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import RobotData
from ccatp.onboard.controlled import SAME_S, ControlledRobot
from ccatp.onboard.hardware import Hardware, HardwareError
from ccatp.onboard.rules import HELD, SlideMonitor
from ccatp.onboard.wheel_servo import WheelServo

# Without these the robot does not move. Its clients decide what to do about a weak fan or battery.
NEEDED = ("imu", "encoder_right", "encoder_left", "edge", "stall")
_SLIDE_HOLD_S = 0.5
# Wheels and edge sensors have up to 1000 samples a second, and a frame may last 50 ms, or somewhat longer.
FAST_SAMPLES = 54

WheelRates = tuple[float, float | None, float | None]


class EdgeThreshold:
    """Converts the voltage of one analogue edge sensor to a bit: threshold, hysteresis, debouncing.

    A change to *no panel* takes effect with its first sample, because a late report of the rim lengthens the stopping
    distance. The change back must last for ``debounce_s``. The first sample takes effect at once.
    """

    def __init__(self, cfg: EdgeThresholdConfig) -> None:
        sign = 1.0 if cfg.is_panel_above else -1.0
        self._sign, self._debounce_s = sign, cfg.debounce_s
        half_v = 0.5 * cfg.hysteresis_v
        self._on_v, self._off_v = sign * cfg.threshold_v + half_v, sign * cfg.threshold_v - half_v
        self._is_on = False
        # A first sample above the threshold is not debounced.
        self._above_since_s: float | None = -inf

    def read(self, t_s: float, voltage_v: float) -> int:
        """1 = panel under the sensor, 0 = no panel; NaN gives 0."""
        level_v = self._sign * voltage_v
        if self._is_on:
            self._is_on = level_v >= self._off_v
            self._above_since_s = None
        elif level_v >= self._on_v:
            if self._above_since_s is None:
                self._above_since_s = t_s
            self._is_on = t_s - self._above_since_s >= self._debounce_s
        else:
            self._above_since_s = None
        return int(self._is_on)


class OnboardRobot(ControlledRobot):
    """The robot; ``hardware`` has been started. The barrier outside this program is the external timer.

    Attributes:
        voltages_v: of the (right, left) motor.
    """

    def __init__(self, cfg: OnboardConfig, hardware: Hardware, commands_delay_frames: int = 0) -> None:
        link, robot = cfg.link, cfg.robot
        limits = link.ttl_s, robot.max_wheel_rad_s, robot.fan_floor
        super().__init__(limits, link.frame_hz, link.sample_latency_s, commands_delay_frames)
        self._cfg, self._hardware = cfg, hardware
        self.loop_hz = cfg.servo.loop_hz
        self._servos = WheelServo(cfg.servo), WheelServo(cfg.servo)
        self._edges = [EdgeThreshold(cfg.edges) for _ in range(4)]  # in the order of the robot link
        self._rad_per_count = 2.0 * pi / cfg.servo.counts_per_rev
        self._last_counts: tuple[float, int | None, int | None] | None = None
        self._slides = SlideMonitor(
            (robot.grip_slide_m_s, robot.grip_turn_rad), robot.wheel_radius_m, robot.wheel_base_m
        )
        self._slides_until_s = 0.0
        self.voltages_v = 0.0, 0.0
        self._control_s: float | None = None
        self._soc, self._stall = 1.0, ""
        # Samples that are not in a frame yet.
        self._imu: list[tuple[float, float, float]] = []
        self._enc: list[WheelRates] = []
        self._edge: list[tuple[float, int, int, int, int]] = []
        self._gravity: tuple[float, float, float, float] | None = None  # of no frame yet
        self._downhill: tuple[float, float, float, float] | None = None
        # The fans keep their duties; the floor applies from the first command.
        self.fans.duty = self._duty_in_force = hardware.fans()

    def describe(self) -> RobotData:
        robot = self._cfg.robot
        return RobotData(
            robot.wheel_radius_m, robot.wheel_base_m, robot.edge_sensors_m, robot.puck_m, robot.max_wheel_rad_s,
            robot.fan_floor,
        )  # fmt: skip

    # -- the wheels ---------------------------------------------------------------------------------------------------

    def control(self, now_s: float) -> None:
        """Read the devices and set the motor voltages and fans, at ``now_s`` of the robot's clock."""
        last_s, self._control_s = self._control_s, now_s
        self._take_readings(now_s)
        dt_s = 1.0 / self.loop_hz if last_s is None else now_s - last_s
        right_set, left_set = self.rules.set_points(now_s)
        is_late = dt_s > self._cfg.devices.timer.timeout_s
        self.late_steps += is_late
        right, left = self._servos
        for servo, name in ((right, "right"), (left, "left")):
            if servo.is_stalled:
                self._stall = f"full voltage and no motion, {name} wheel"
        if not (right_set or left_set):
            self._stall = ""
        if self._stall:
            self.faults["stall"] = self._stall
        if is_late or now_s < self._slides_until_s or not self.faults.keys().isdisjoint(NEEDED):
            right_set, left_set = HELD
            self.rules.is_held = True
        try:
            if is_late or "encoder_right" in self.faults or "encoder_left" in self.faults:
                # Without an encoder the servo could drive its wheel at any speed.
                self._brake()
            else:
                self.voltages_v = right.step(dt_s, right_set), left.step(dt_s, left_set)
                self._hardware.drive(*self.voltages_v)
            self.faults.pop("motors", None)
        except HardwareError as error:
            self.faults["motors"] = str(error)
        self._write_fans()

    def _brake(self) -> None:
        for servo in self._servos:
            servo.release()
        self.voltages_v = 0.0, 0.0
        self._hardware.brake()

    def _take_readings(self, now_s: float) -> None:
        readings = self._hardware.read(now_s)
        self.faults = dict(readings.faults)
        self._soc = readings.soc
        self._imu += [row[:3] for row in readings.imu]
        self._gravity = readings.gravity or self._gravity
        self._downhill = readings.gravity or self._downhill
        for t_s, right, left in readings.counts:
            self._count(t_s, right, left)
        a, b, c, d = self._edges
        for t_s, a_v, b_v, c_v, d_v in readings.edges:
            self._edge.append((t_s, a.read(t_s, a_v), b.read(t_s, b_v), c.read(t_s, c_v), d.read(t_s, d_v)))
        if readings.imu and self._last_counts is not None:
            right_rad, left_rad = [None if n is None else n * self._rad_per_count for n in self._last_counts[1:]]
            if self._slides.step(readings.imu[-1], (right_rad, left_rad), self._downhill):
                self._slides_until_s = now_s + _SLIDE_HOLD_S
                self.fans.command(1.0, 1.0)

    def _count(self, t_s: float, right: int | None, left: int | None) -> None:
        """Compute wheel speeds from the counts since the last reading; their integral is exactly the angle."""
        last, self._last_counts = self._last_counts, (t_s, right, left)
        for servo, count in zip(self._servos, (right, left), strict=True):
            if count is not None:
                servo.count(t_s, count)
        if last is None or t_s <= last[0]:
            return
        dt_s = t_s - last[0]
        if dt_s > self._cfg.devices.daq.timeout_s:
            return  # a gap: the wheel speeds within it are not known
        rates = [
            None if now is None or before is None else (now - before) * self._rad_per_count / dt_s
            for now, before in ((right, last[1]), (left, last[2]))
        ]
        if rates != [None, None]:
            self._enc.append((t_s, rates[0], rates[1]))

    def _write_fans(self) -> None:
        duty = self.fans.duty
        if duty == self._duty_in_force:
            return
        try:
            self._hardware.command_fans(*duty)
            self._duty_in_force = duty
        except HardwareError as error:
            self.faults["fan_left"] = self.faults["fan_right"] = str(error)

    # -- frames -------------------------------------------------------------------------------------------------------

    def _close_frame(self, t_s: float) -> None:
        since_s, self.t_s = self.t_s, t_s
        # Clients see a motor that cannot be set as a stalled motor.
        faults = tuple(sorted({"stall" if name == "motors" else name for name in self.faults}))
        gravity = self._gravity if self._gravity is not None and self._gravity[0] <= t_s + SAME_S else None
        if gravity is not None:
            self._gravity = None
        frame = RobotFrame(
            self.seq,
            round(t_s, 6),
            imu=self._take_samples(self._imu, since_s),
            enc=self._take_samples(self._enc, since_s, FAST_SAMPLES),
            edge=self._take_samples(self._edge, since_s, FAST_SAMPLES),
            gravity=gravity,
            fans=self.fans.duty,
            soc=self._soc,
            cmd=self._echo(t_s),
            faults=faults,
            sliding=t_s < self._slides_until_s,
        )
        self._line = encode(frame)
        self.delivered_seq = self.seq
