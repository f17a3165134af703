"""Finds the parameters of the wheel servos by driving free wheels: friction, slope, time constant, gains.

A geared DC motor obeys ``T dw/dt + w = (V - V_static sign(w)) / slope``. Steps of constant voltage give the static
voltage and slope of each wheel (least squares over both directions); a step from rest gives its time constant. With the
PI servo the speed error has the characteristic polynomial ``slope T s^2 + (slope + kp) s + ki``; both poles are at -w0,
``w0 = POLES / response_s``. A step with the servo and these gains then measures how well the wheel follows.
"""

from collections.abc import Callable, Sequence
from math import copysign, exp, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.onboard_models import WheelServoConfig
from ccatp.onboard.hardware import Hardware, HardwareError
from ccatp.onboard.wheel_servo import WheelServo

POLES = 4.0  # rate of decay of the speed error / rate at which the servo follows the set point
_LEVELS = 8
_HOLD_S, _SETTLED_S = 0.6, 0.3
_LEAST_RATE_RAD_S = 0.2  # of a measurement: a slower wheel may stick
_TOP_SHARE = 0.8  # of the largest voltage
_STEP_S = 0.8
_STEP_SHARE = 0.5  # of the speed at the top voltage
_MOST_DIFFERENCE = 0.1  # of the two wheels' slopes, relative to the larger one

Trace = list[tuple[float, float, float]]


class WheelTuning(NamedTuple):
    """One wheel: static voltage, V; slope, V per rad/s; time constant, s; rms residual of the straight line, V."""

    static_v: float
    volt_per_rad_s: float
    time_constant_s: float
    residual_v: float


class Tuning(NamedTuple):
    """Result of the tuning.

    right, left: each wheel. values: new values of keys of ``[servo]``. step: (time s, speed rad/s, reference rad/s) of
    the right wheel with the servo and these values. deviation_rad_s: rms of speed minus reference. overshoot_share:
    largest speed / mean speed of the second half of the step - 1, at least 0.
    """

    right: WheelTuning
    left: WheelTuning
    values: dict[str, float]
    step: Trace
    deviation_rad_s: float
    overshoot_share: float


class _Bench:
    """Runs free wheels at given voltages."""

    def __init__(
        self, hardware: Hardware, cfg: WheelServoConfig, now: Callable[[], float], sleep: Callable[[float], None]
    ) -> None:
        self._hardware, self._cfg, self._now, self._sleep = hardware, cfg, now, sleep
        self.servos = WheelServo(cfg), WheelServo(cfg)

    def hold(self, duration_s: float, voltages: Callable[[float], tuple[float, float]]) -> list[tuple[float, ...]]:
        """Apply ``voltages(dt)`` for a time; rows of (t, right, left speed), s and rad/s. Raises ``HardwareError``."""
        rows: list[tuple[float, ...]] = []
        start_s = last_s = self._now()
        while last_s - start_s < duration_s:
            self._sleep(1.0 / self._cfg.loop_hz)
            now_s = self._now()
            readings = self._hardware.read(now_s)
            for name in ("encoder_right", "encoder_left"):
                if name in readings.faults:
                    raise HardwareError(f"{name}: {readings.faults[name]}")
            for t_s, *counts in readings.counts:
                for servo, count in zip(self.servos, counts, strict=True):
                    if count is not None:
                        servo.count(t_s, count)
            self._hardware.drive(*voltages(now_s - last_s))
            last_s = now_s
            rows.append((now_s - start_s, *(servo.rate_rad_s for servo in self.servos)))
        return rows


def tune(
    hardware: Hardware,
    cfg: WheelServoConfig,
    now: Callable[[], float],
    sleep: Callable[[float], None],
    say: Callable[[str], None] = lambda _: None,
) -> Tuning:
    """Tune both wheels, which must turn freely; ``hardware`` has been started. The motors brake at the end.

    Raises ``HardwareError`` if a device fails or a wheel does not turn, turns the wrong way, or differs from the other.
    """
    bench = _Bench(hardware, cfg, now, sleep)
    try:
        top_v = _TOP_SHARE * cfg.max_v
        levels = [top_v * (k + 1) / _LEVELS for k in range(_LEVELS)]
        speeds: list[tuple[float, float, float]] = []
        for sign in (1.0, -1.0):
            for level_v in levels:
                voltage_v = sign * level_v
                rows = bench.hold(_HOLD_S, lambda _, v=voltage_v: (v, v))  # type: ignore[misc]
                settled = [row for row in rows if row[0] >= _SETTLED_S]
                right, left = (float(np.mean([row[k] for row in settled])) for k in (1, 2))
                say(f"{voltage_v:6.2f} V: right {right:7.3f} rad/s, left {left:7.3f} rad/s")
                speeds.append((voltage_v, right, left))
            bench.hold(_HOLD_S, lambda _: (0.0, 0.0))
        rises = bench.hold(_STEP_S, lambda _: (top_v, top_v))
        bench.hold(_HOLD_S, lambda _: (0.0, 0.0))
        found = [_fit(speeds, rises, k, name) for k, name in ((1, "right"), (2, "left"))]
        right_wheel, left_wheel = found
        slopes = right_wheel.volt_per_rad_s, left_wheel.volt_per_rad_s
        if abs(slopes[0] - slopes[1]) > _MOST_DIFFERENCE * max(slopes):
            raise HardwareError(
                f"the right wheel needs {slopes[0]:.3g} V per rad/s, the left one {slopes[1]:.3g}: "
                "one of them rubs, or its motor or gear is another one"
            )
        values = _gains(found, cfg)
        bench.servos = tuple(WheelServo(cfg.model_copy(update=values)) for _ in range(2))  # type: ignore[assignment]
        step, deviation, overshoot = _show_step(bench, cfg, _STEP_SHARE * (top_v - values["static_v"]) / slopes[0])
        return Tuning(right_wheel, left_wheel, values, step, deviation, overshoot)
    finally:
        hardware.brake()


def _fit(speeds: Sequence[Sequence[float]], rises: Sequence[Sequence[float]], k: int, name: str) -> WheelTuning:
    moving = [(abs(row[0]), row[k] * copysign(1.0, row[0])) for row in speeds if abs(row[k]) > _LEAST_RATE_RAD_S]
    if len(moving) < _LEVELS:
        raise HardwareError(
            f"the {name} wheel hardly turns: look at the motor's supply, its two lines, and the encoder; "
            "or raise servo.max_v"
        )
    if any(rate_rad_s < 0.0 for _, rate_rad_s in moving):
        raise HardwareError(
            f"the {name} wheel turns against its voltage: exchange forward_line and reverse_line in "
            f"devices.motors.{name}, or the encoder's two channels"
        )
    design = np.array([(1.0, rate_rad_s) for _, rate_rad_s in moving])
    volts = np.array([volt for volt, _ in moving])
    (static_v, slope), *_ = np.linalg.lstsq(design, volts, rcond=None)
    residual_v = sqrt(float(np.mean((design @ (static_v, slope) - volts) ** 2)))
    end_rad_s = float(np.mean([row[k] for row in rises if row[0] >= _SETTLED_S]))
    reached_s = next((row[0] for row in rises if row[k] >= (1.0 - exp(-1.0)) * end_rad_s), _SETTLED_S)
    return WheelTuning(max(float(static_v), 0.0), float(slope), reached_s, residual_v)


def _gains(found: Sequence[WheelTuning], cfg: WheelServoConfig) -> dict[str, float]:
    static_v, slope, time_s = (sum(one[k] for one in found) / len(found) for k in range(3))
    # The speed is measured over a window; its delay of half the window is not part of the motor's time constant.
    time_s = max(time_s - 0.5 * cfg.speed_window_s, 1.0 / cfg.loop_hz)
    poles = POLES / cfg.response_s
    return {
        "static_v": round(static_v, 3),
        "volt_per_rad_s": round(slope, 4),
        "proportional_v_per_rad_s": round(max(2.0 * poles * slope * time_s - slope, 0.0), 3),
        "integral_v_per_rad": round(slope * time_s * poles * poles, 2),
    }


def _show_step(bench: _Bench, cfg: WheelServoConfig, speed_rad_s: float) -> tuple[Trace, float, float]:
    right, left = bench.servos
    rows = bench.hold(_STEP_S, lambda dt_s: (right.step(dt_s, speed_rad_s), left.step(dt_s, speed_rad_s)))
    trace = [(t_s, rate, speed_rad_s * (1.0 - exp(-t_s / cfg.response_s))) for t_s, rate, _ in rows]
    deviation = sqrt(sum((rate - wanted) ** 2 for _, rate, wanted in trace) / len(trace))
    # The mean of several speeds reduces the quantization error of the counts.
    tail = [rate for t_s, rate, _ in trace if t_s > 0.5 * _STEP_S]
    overshoot = max(max(rate for _, rate, _ in trace) / (sum(tail) / len(tail)) - 1.0, 0.0)
    return trace, deviation, overshoot
