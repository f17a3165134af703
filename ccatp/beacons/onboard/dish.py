"""The reflector on its stepper motor: one step for each call, its position in steps, and its end switch.

Position 0 is straight ahead, where the end switch closes; positions grow to the left. The cable allows one turn, so the
dish turns back after each scan.
"""

from ccatp.beacons.config.onboard_models import DishConfig
from ccatp.onboard.devices.outputs import InputLine, OpenInput, OpenLines, OutputLines
from ccatp.onboard.hardware import HardwareError

_SEARCHED = 1.1  # turns in which the switch must close
_LEAVES = 0.1  # turns in which it must open
_BEYOND = 0.25  # turns: the dish turns back by as much beyond straight ahead, then the cable is tight


class Dish:
    """The motor.

    Attributes:
        position: steps from straight ahead, as commanded.
        is_homed: the position is known.
        lost_steps: by which the end switch was missed at the newest return; 0 without a switch.
    """

    def __init__(self, config: DishConfig, open_lines: OpenLines, open_input: OpenInput) -> None:
        self._config, self._open_lines, self._open_input = config, open_lines, open_input
        self._lines: OutputLines | None = None
        self._switch: InputLine | None = None
        self._is_leaving = False  # the switch is closed at first: step off it, and find where it closes
        self.position = self.lost_steps = 0
        self.is_homed = False

    @property
    def identity(self) -> str:
        """Chip, lines, homing."""
        config = self._config
        return f"{config.gpio_chip} lines {config.step_line}, {config.direction_line}, homing by {config.homing}"

    @property
    def is_open(self) -> bool:
        """Whether its lines are open."""
        return self._lines is not None

    def open(self) -> None:
        """Open the lines. Raises HardwareError."""
        config = self._config
        values = {config.step_line: False, config.direction_line: config.left_is_high}
        self._lines = self._open_lines(config.gpio_chip, values)
        if config.homing == "switch":
            self._switch = self._open_input(config.gpio_chip, config.switch_line)
        self.begin_homing()

    def begin_homing(self) -> None:
        """Search straight ahead by ``home``. Without a switch the dish was turned there by hand."""
        self.is_homed = self._config.homing == "hand"
        self._is_leaving = self._switch is not None and self._is_closed()

    def home(self) -> bool:
        """One step of the search; true at its end. Raises HardwareError: no switch in a turn."""
        if self.is_homed:
            return True
        if self._is_leaving:
            self._is_leaving = self._is_closed()
            if self._is_leaving:
                self._search(1)
                return False
        if not self._is_closed():
            self._search(-1)
            return False
        self.position, self.is_homed = 0, True
        return True

    def turn(self, aim: int) -> bool:
        """One step towards a position; true at the aim. Raises HardwareError."""
        if self.position == aim:
            return True
        self._step(1 if aim > self.position else -1)
        return self.position == aim

    def turn_back(self) -> bool:
        """One step back to straight ahead; true at its end, with ``lost_steps``. Raises HardwareError."""
        if self._switch is None:
            return self.turn(0)
        if self._is_closed():
            self.lost_steps, self.position = self.position, 0
            return True
        if self.position < -_BEYOND * self._config.steps_per_turn:
            self.is_homed = False
            raise HardwareError("dish: its end switch does not close any more; check devices.dish.switch_line")
        self._step(-1)
        return False

    def _search(self, direction: int) -> None:
        """One step; further attempts do not wind the cable any further, because the position goes on counting."""
        turn = self._config.steps_per_turn
        if direction > 0 and self.position >= _LEAVES * turn:
            raise HardwareError("dish: its end switch does not open; check devices.dish.switch_line, motor and supply")
        if direction < 0 and self.position <= -_SEARCHED * turn:
            raise HardwareError("dish: no end switch in a turn; check devices.dish.switch_line, motor and supply")
        self._step(direction)

    def _step(self, direction: int) -> None:
        if self._lines is None:
            raise HardwareError("dish: is not open")
        config = self._config
        self._lines.set({config.direction_line: (direction > 0) == config.left_is_high})
        self._lines.set({config.step_line: True})
        self._lines.set({config.step_line: False})
        self.position += direction

    def _is_closed(self) -> bool:
        return self._switch is not None and self._switch.get() == self._config.switch_is_high

    def close(self) -> None:
        """Release the lines; the motor is not stepped any more."""
        for line in (self._lines, self._switch):
            if line is not None:
                line.close()
        self._lines = self._switch = None
