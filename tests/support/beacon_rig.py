"""The on-board program of a robot among beacons over fake devices in the simulated world, in virtual time."""

from math import ceil
from typing import Any

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.config.onboard_load import load_beacon_onboard_config
from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from ccatp.beacons.onboard.hardware import BeaconAccess, BeaconHardware
from ccatp.beacons.onboard.robot import BeaconOnboardRobot
from ccatp.beacons.sim.radio_world import RadioWorld
from ccatp.beacons.sim.robot import SimulatedBeaconRobot, listener_of, motes_of
from tests.support.beacon_fakes import CYCLE_S, FakeDish, FakeMote, FakePioneer, FakePort, FakeXBee, drive_command
from tests.support.onboard_fakes import FakeTime
from tests.support.scenario import radio_config_of

# What differs with this robot: two driven wheels, whole scans of a reflector, which take seconds in which it stands.
PIONEER: dict[str, Any] = {
    "vehicle__kind": "differential",
    "sim__radio__scan": "reflector",
    "observation__target_every_steps": 30,
    "danger__radio_timeout_s": 25.0,
    "mission__time_limit_s": 3000.0,
}
# A scan takes ten seconds and more instead of none: the target moves as far between two scans as in the simulation.
SLOWER = {"mission__follow_s": 450.0, "sim__target__speed_m_s": 0.0065, "follow__lost_after_s": 60.0}
REAR_SONARS = [15, 14, 13, 12, 11, 10, 9, 8]


def pioneer_config(system: str = "zigbee", /, **overrides: Any) -> RadioConfig:
    """The shipped configuration for a Pioneer, with changes."""
    return radio_config_of(system, **(PIONEER | overrides))


def onboard_config(cfg: RadioConfig, **overrides: Any) -> BeaconOnboardConfig:
    """The configuration of the program that fits that of the controller; keys with ``__`` for dots."""
    angles = list(cfg.avoidance.sensors_rad)
    names = [*cfg.sim.beacons, *([cfg.follow.target] if cfg.sim.target.motion != "none" else [])]
    is_cricket, motes = cfg.system == "cricket", motes_of(cfg)
    settings: dict[str, Any] = {
        "link.port": 0,
        "link.host": "127.0.0.1",
        "robot.wheel_radius_m": cfg.robot.wheel_radius_m,
        "robot.track_m": cfg.vehicle.track_m,
        "robot.axle_distance_m": cfg.vehicle.wheelbase_m,
        "robot.loop_hz": 100.0,
        "devices.base.sonars": [7, 6, 5, 4, 3, 2, 1, 0, *REAR_SONARS][: len(angles)],
        "devices.base.sonars_rad": angles,
        "devices.base.baud": 115200 if is_cricket else 9600,
        "devices.radio.names": names,
        "devices.radio.is_used": not is_cricket,
        "devices.dish.is_used": not is_cricket,
        "devices.listeners.is_used": is_cricket,
    }
    if motes is not None:
        listeners = (cfg.listener.name, *motes.names)
        settings |= {f"devices.listeners.devices.{name}": f"/dev/mote-{name}" for name in listeners}
    return load_beacon_onboard_config(None, settings | {key.replace("__", "."): v for key, v in overrides.items()})


class BeaconBench:
    """All fakes in the world of a configuration."""

    def __init__(
        self, cfg: RadioConfig, onboard: BeaconOnboardConfig | None = None, time: FakeTime | None = None
    ) -> None:
        self.cfg, self.onboard = cfg, onboard_config(cfg) if onboard is None else onboard
        self.time = FakeTime(0.0) if time is None else time
        self.world = RadioWorld(cfg)
        self.motes = motes_of(cfg)
        self._listener = None if self.motes is None else listener_of(cfg, self.motes)
        dish, base = self.onboard.devices.dish, self.onboard.devices.base
        self._distances_m = [5.0] * len(base.sonars)
        self.dish = FakeDish(dish.step_line, dish.direction_line, dish.steps_per_turn)
        self.radio = FakeXBee(self.time, list(self.onboard.devices.radio.names), self._level)
        self.radio.api_mode = self.onboard.devices.radio.api_mode
        self.base = FakePioneer(self.time, self._move, self._sonars_m, cfg.vehicle.track_m)
        listeners = self.onboard.devices.listeners
        self.listeners = {
            name: FakeMote(self.time, f"1:{k:x}:61:61:b:0:0:42", cfg.cricket.sim.temperature_c)
            for k, name in enumerate(listeners.devices if listeners.is_used else ())
        }
        ports: dict[str, FakePort] = {base.device: self.base, self.onboard.devices.radio.device: self.radio}
        ports |= {device: self.listeners[name] for name, device in listeners.devices.items() if name in self.listeners}
        self.ports = ports

    def _level(self, name: str) -> float | None:
        return self.world.level(name, self.dish.direction_rad)

    def _move(self, velocity_m_s: float, turn_rad_s: float) -> tuple[float, float]:
        frame = self.world.step(drive_command(velocity_m_s, turn_rad_s), CYCLE_S, static=False, target=False)
        self._distances_m = frame.extras.distances
        if self._listener is not None:
            for burst in self._listener.receive(self.world.time_s, self.world.pose):
                for delay_s in burst.delays_s if burst.listener in self.listeners else ():
                    self.listeners[burst.listener].pulse(self._id_of(burst.sender), burst.sender, delay_s)
        if not (velocity_m_s or turn_rad_s):
            return 0.0, 0.0  # encoders of a robot that stands do not count
        return frame.wheels.speed_m_s, frame.wheels.turn_rate_rad_s

    def _id_of(self, mote: str) -> str:
        """Unique id of a mote."""
        if mote in self.listeners:
            return self.listeners[mote].unique_id
        assert self.motes is not None
        return f"1:{self.motes.names.index(mote):x}:61:61:b:0:0:1"

    def _sonars_m(self) -> list[float]:
        base = self.onboard.devices.base
        found = dict(zip(base.sonars, self._distances_m, strict=True))
        return [found.get(number, 5.0) for number in range(16)]


class BeaconRig(BeaconBench):
    """The fakes, and the devices of the program on them, in virtual time."""

    def __init__(self, cfg: RadioConfig, onboard: BeaconOnboardConfig | None = None) -> None:
        super().__init__(cfg, onboard)
        access = BeaconAccess(
            lambda device, _baud, _key: self.ports[device].open(),
            self.dish.open_lines, self.dish.open_input, self.time.sleep,
        )  # fmt: skip
        self.hardware = BeaconHardware(self.onboard, self.time, access)


class DrivenRobot(BeaconOnboardRobot, SimulatedBeaconRobot):
    """The program's robot, driven frame by frame like a simulated one."""

    def __init__(self, rig: BeaconRig) -> None:
        self.rig, self.world, self.motes = rig, rig.world, rig.motes
        rig.hardware.start()
        super().__init__(rig.onboard, rig.hardware)
        self.seq = ceil(rig.time.now_s * self.frame_hz) + 1
        self.t_s = self.seq / self.frame_hz
        self._steps = round(rig.time.now_s * rig.onboard.robot.loop_hz) + 1
        self._run()
        self._close_frame(self.t_s)

    def _run(self) -> None:
        """The control loop up to the time of the frame ``seq``."""
        loop_hz = self.rig.onboard.robot.loop_hz
        while self._steps <= self.seq / self.frame_hz * loop_hz + 1e-6:
            self.rig.time.now_s = self._steps / loop_hz
            self.control(self.rig.time.now_s)
            self._steps += 1

    def advance(self) -> None:
        self._release_commands()
        self.seq += 1
        self._run()
        self._close_frame(self.seq / self.frame_hz)

    @property
    def next_t_s(self) -> float:
        return (self.seq + 1) / self.frame_hz
