"""The kinds of robots with a program on their own computer, found by the name that a configuration gives as ``kind``.

A part of a kind is the place of an object, imported when the kind is chosen: the package of one robot contains nothing
of the others. Another package adds a kind by an entry point of the group ``ccatp.robots``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from ccatp.config.load import ConfigSource, Overrides, nested, read_source, strongest
from ccatp.config.messages import choice_hint, format_value
from ccatp.config.onboard_models import OnboardLinkConfig
from ccatp.errors import ConfigError
from ccatp.missions import Part
from ccatp.onboard.controlled import ControlledRobot
from ccatp.onboard.hardware import DeviceCheck

# Places of the kinds of this project; a package may contain only one of them.
BUILT_IN = {"mirror": "ccatp.onboard.kind:MIRROR", "beacons": "ccatp.beacons.onboard.kind:BEACONS"}
DEFAULT = "mirror"
GROUP = "ccatp.robots"


class RobotHardware(Protocol):
    """The devices of any robot."""

    def start(self) -> None:
        """Open and set up every device; the wheels are held. Raises ``HardwareError``."""

    def check(self, duration_s: float) -> list[DeviceCheck]:
        """Open each device, read for ``duration_s`` while the robot stands still, and close."""

    def close(self) -> None:
        """Hold the wheels and release the devices."""


class OnboardCommonConfig(Protocol):
    """What the configurations of all kinds have."""

    @property
    def link(self) -> OnboardLinkConfig:
        """The robot link."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotKind:
    """One kind of robot; ``C`` below is the class of its configuration.

    ``no_tuning``: why it has no servos to tune, with advice; empty: it has.
    """

    load: Part  # Callable[[Path | None, Overrides], C]
    make_hardware: Part  # Callable[[C, Callable[[], float]], RobotHardware]; the robot's clock
    make_robot: Part  # Callable[[C, RobotHardware], ControlledRobot]
    no_tuning: str = ""

    def hardware(self, cfg: OnboardCommonConfig, clock: Callable[[], float]) -> RobotHardware:
        """The devices, not opened yet."""
        made: RobotHardware = self.make_hardware.get()(cfg, clock)
        return made

    def robot(self, cfg: OnboardCommonConfig, hardware: RobotHardware) -> ControlledRobot:
        """The robot on started hardware."""
        made: ControlledRobot = self.make_robot.get()(cfg, hardware)
        return made


def kind_in(file: Path | None, overrides: Overrides = None) -> RobotKind:
    """The kind of a configuration: that of ``kind`` on the command line, else in the file. Raises ConfigError."""
    command = ConfigSource("command line", "", nested(overrides or {}))
    sources = [command] if file is None else [command, read_source(file)]
    source, key = strongest(sources, ("kind",))
    name: Any = source.tree.get("kind", DEFAULT)
    places = BUILT_IN | {point.name: point.value for point in entry_points(group=GROUP)}
    if not isinstance(name, str) or name not in places:
        hint = choice_hint(str(name), list(places))
        raise ConfigError(f"{source.place(key)}: kind = {format_value(name)} is no kind of robot; {hint}")
    try:
        kind: RobotKind = Part(places[name]).get()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{source.place(key)}: kind = {format_value(name)}: {error.name} is not installed; "
            "install the package of this robot"
        ) from error
    return kind


def load_robot_config(file: Path | None, overrides: Overrides = None) -> tuple[RobotKind, OnboardCommonConfig]:
    """The kind of a configuration, and the configuration. Raises ConfigError."""
    kind = kind_in(file, overrides)
    cfg: OnboardCommonConfig = kind.load.get()(file, overrides)
    return kind, cfg
