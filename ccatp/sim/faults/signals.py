"""Pure. The signals of a frame: in which list they stand, in which places of its rows, and their ranges."""

from typing import NamedTuple

# Ranges of random readings: those of common parts (accelerometer 2 g, gyroscope 2000 deg/s), twice the wheels' limit.
_AX_M_S2, _WZ_RAD_S, _WHEEL_RAD_S = 19.6, 34.9, 16.0


class Signal(NamedTuple):
    """Where a signal stands.

    Attributes:
        rows: name of the list.
        columns: places in a row, the time being place 0.
        low, high: range of each of its numbers.
        is_binary: it is 0 or 1.
    """

    rows: str
    columns: tuple[int, ...]
    low: float
    high: float
    is_binary: bool = False


SIGNALS = {
    "imu_ax": Signal("imu", (1,), -_AX_M_S2, _AX_M_S2),
    "imu_wz": Signal("imu", (2,), -_WZ_RAD_S, _WZ_RAD_S),
    "encoder_right": Signal("enc", (1,), -_WHEEL_RAD_S, _WHEEL_RAD_S),
    "encoder_left": Signal("enc", (2,), -_WHEEL_RAD_S, _WHEEL_RAD_S),
    "edge_front_left": Signal("edge", (1,), 0.0, 1.0, is_binary=True),
    "edge_front_right": Signal("edge", (2,), 0.0, 1.0, is_binary=True),
    "edge_rear_left": Signal("edge", (3,), 0.0, 1.0, is_binary=True),
    "edge_rear_right": Signal("edge", (4,), 0.0, 1.0, is_binary=True),
    "gravity": Signal("gravity", (1, 2, 3), -1.0, 1.0),
    "fans": Signal("fans", (1, 2), 0.0, 1.0),
    "soc": Signal("soc", (1,), 0.0, 1.0),
}
