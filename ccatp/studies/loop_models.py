"""Pure. The open loops of the controllers as transfer functions, their margins, frequency responses and root loci.

Needs the extra ``tune`` (python-control), imported only when a system is built.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf, pi, sqrt, tau
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ccatp.angles import wrap_pi
from ccatp.config.models import Config, ControlConfig, LimitsConfig, PidConfig
from ccatp.errors import CcatpError, ExitStatus
from ccatp.samples import FloatArray

if TYPE_CHECKING:
    from control import TransferFunction

Coefficients = tuple[float, ...]
"""A polynomial in s, highest power first."""

DELAYS_FRAMES = (0, 2, 4)  # link delay there and back: none, that of the world `hard`, that of `extreme`
LIMIT_LAGS = (0.5, 0.25, 0.1, 0.01, 0.001)  # of the wheel servo's: towards the limit T -> 0
OMEGA_RAD_S = (1e-4, 300.0)  # the controller samples at 100 Hz: beyond 314 rad/s it has no loop
GRID_POINTS = 4001
# Of the delay, for poles and step responses only: right to 1e-5 rad up to 2 rad per delay.
PADE_ORDER = 4


class LoopsError(CcatpError):
    """The analysis cannot be made: a package of an extra is missing."""

    exit_status = ExitStatus.USAGE


@dataclass(frozen=True, slots=True)
class Loop:
    """One open loop L(s) = C(s) P(s) exp(-s tau).

    Attributes:
        gains: name of the set of gains.
        axis: ``forward`` (distance, m), ``angular`` (turn in place, rad) or ``steering`` (heading on a leg, rad).
        plant: ``printed``, 1/(T s + 1), or ``true``, 1/(s (T s + 1)): a speed command reaches the position by way of
            an integrator, which the thesis leaves out.
        lag_s: T.
        delay_frames: link delay there and back, frames.
        delay_s: tau, the same in seconds.
        numerator, denominator: of C P, highest power first.
    """

    gains: str
    axis: str
    plant: str
    lag_s: float
    delay_frames: int
    delay_s: float
    numerator: Coefficients
    denominator: Coefficients


class Margins(NamedTuple):
    """What separates a loop from instability; ``inf`` where nothing does.

    Attributes:
        gain_db: the gain may grow by this before the loop becomes unstable; negative if it has to shrink.
        phase_rad: least phase margin over all gain crossovers.
        modulus: least distance of L(j w) from -1.
        gain_crossover_rad_s, phase_crossover_rad_s: where the phase and the gain margin are taken.
        delay_s: further delay that uses up the phase margin.
        is_stable: whether the closed loop is.
    """

    gain_db: float
    phase_rad: float
    modulus: float
    gain_crossover_rad_s: float
    phase_crossover_rad_s: float
    delay_s: float
    is_stable: bool


def controller(gains: PidConfig, is_filtered: bool) -> tuple[Coefficients, Coefficients]:
    """Numerator and denominator of C(s) = Kp + Ki/s + Kd s/(Tf s + 1), thesis eq. 3.4 with Tf = 0 unless filtered."""
    filter_s = gains.derivative_filter_s if is_filtered and gains.kd else 0.0
    numerator: Coefficients = (gains.kd + filter_s * gains.kp, gains.kp + filter_s * gains.ki, gains.ki)
    denominator: Coefficients = (filter_s, 1.0, 0.0)
    if gains.ki == 0.0:  # else a pole and a zero at the origin would cancel
        numerator, denominator = numerator[:2], denominator[:2]
    return _trimmed(numerator), _trimmed(denominator)


def steering(limits: LimitsConfig, control: ControlConfig) -> PidConfig:
    """The regulator on the line as a controller of the heading, at full speed.

    Its law omega = -g v e - k theta with k = sqrt(w + 2 g v^2) and e' = v theta is C(s) = k + g v^2 / s on the heading.
    """
    pull = control.cross_track_gain_rad_m2 * limits.v_max_m_s**2
    kp = sqrt(control.heading_weight_1_s2 + 2.0 * pull)
    return PidConfig(kp=kp, ki=pull, kd=0.0, derivative_filter_s=0.0, integral_limit=0.0)


def open_loop(
    name: str, axis: str, gains: PidConfig, plant: str, lag_s: float, delay_frames: int, frame_s: float,
    *, is_filtered: bool = False,
) -> Loop:  # fmt: skip
    """Loop of one controller on one plant, its derivative filtered or not.

    The sampling of the controller itself is left out: its hold is half a frame, two degrees at the fastest crossover
    here. So is the prediction of the commands under way: the margins with a delay are those without its help.
    """
    numerator, denominator = controller(gains, is_filtered)
    servo = (lag_s, 1.0, 0.0) if plant == "true" else (lag_s, 1.0)
    whole = tuple(float(c) for c in np.polymul(denominator, servo))
    return Loop(name, axis, plant, lag_s, delay_frames, delay_frames * frame_s, numerator, whole)


def loops_of(cfg: Config) -> Iterator[Loop]:
    """Each set of gains, axis, plant and delay; unshaped sets also on the printed plant, as the thesis analysed them.

    A shaped set feeds the tracking error back around a feed-forward: the loop is that of its gains alone, its
    derivative the speed that the estimate has anyway. On its legs the line is held by ``steering``.
    """
    frame_s = 1.0 / cfg.sim.robot.frame_hz
    lag_s = cfg.robot.wheel_lag_s
    for name, gains in cfg.control.gain_sets.items():
        axes = {"forward": gains.forward, "angular": gains.angular}
        if gains.shaped:
            axes["steering"] = steering(cfg.limits, cfg.control)
        for axis, pid in axes.items():
            for plant in ("true",) if gains.shaped else ("printed", "true"):
                for frames in DELAYS_FRAMES:
                    is_filtered = plant == "true" and not gains.shaped  # printed: as eq. 3.4; else as it is built
                    yield open_loop(name, axis, pid, plant, lag_s, frames, frame_s, is_filtered=is_filtered)


def limit_of(cfg: Config) -> Iterator[Loop]:
    """The printed loops of the unshaped sets as the lag goes to zero, where the thesis's phase margin comes from."""
    for name, gains in cfg.control.gain_sets.items():
        if not gains.shaped:
            for axis, pid in (("forward", gains.forward), ("angular", gains.angular)):
                for part in LIMIT_LAGS:
                    yield open_loop(name, axis, pid, "printed", part * cfg.robot.wheel_lag_s, 0, 0.0)


def system(loop: Loop) -> "TransferFunction":
    """L(s) with the delay as a Pade approximant.

    Raises:
        LoopsError: python-control is not installed.
    """
    try:
        import control  # noqa: PLC0415 - takes seconds, and belongs to an extra
    except ImportError as error:
        raise LoopsError("the loops study needs python-control: install ccatp[tune]") from error
    rational = control.TransferFunction(loop.numerator, loop.denominator)
    if loop.delay_s == 0.0:
        return rational
    return rational * control.TransferFunction(*control.pade(loop.delay_s, PADE_ORDER))


def margins(loop: Loop) -> Margins:
    """Margins of the closed loop L/(1 + L), the delay exact, over the frequencies that a sampled controller has."""
    omega = np.geomspace(*OMEGA_RAD_S, GRID_POINTS)
    magnitude, phase = response(loop, omega)
    at_gain = [_root(loop, _log_gain, a, b) for a, b in _changes(omega, np.sign(np.log(magnitude)))]
    at_phase = [_root(loop, _half_turn, a, b) for a, b in _changes(omega, np.floor((phase + pi) / (2.0 * pi)))]
    phases = [(_wrapped(float(response(loop, np.array([w]))[1][0]) + pi), w) for w in at_gain]
    gains = [(-20.0 * _log_gain(w, loop) / np.log(10.0), w) for w in at_phase]
    phase_rad, gain_crossover = min(phases, key=lambda pair: abs(pair[0]), default=(inf, inf))
    gain_db, phase_crossover = min(gains, key=lambda pair: abs(pair[0]), default=(inf, inf))
    spare_s = min(((angle % tau) / w for angle, w in phases), default=inf)
    modulus = float(np.abs(1.0 + magnitude * np.exp(1j * phase)).min())
    return Margins(float(gain_db), phase_rad, modulus, gain_crossover, phase_crossover, spare_s, is_stable(loop))


def is_stable(loop: Loop) -> bool:
    """Whether every pole of L/(1 + L) lies to the left of the axis (the delay as a Pade approximant)."""
    whole = system(loop)
    import control  # noqa: PLC0415 - see ``system``

    return bool((control.feedback(whole, 1).poles().real < 0.0).all())


def overshoot(loop: Loop) -> float:
    """Overshoot of the closed loop's unit step, as a fraction; ``inf`` where the loop is unstable."""
    if not is_stable(loop):
        return inf
    import control  # noqa: PLC0415 - see ``system``

    # The peak comes within a few radians of the crossover; forty see a slowly decaying tail as well.
    time_s = np.linspace(0.0, 40.0 / margins(loop).gain_crossover_rad_s, 4001)
    value = control.step_response(control.feedback(system(loop), 1), time_s).outputs
    return max(0.0, float(value.max()) - 1.0)


def response(loop: Loop, omega_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Magnitude and continuous phase (rad) of L(j omega), the delay exact; both shape (k,)."""
    s = 1j * omega_rad_s
    rational = np.polyval(loop.numerator, s) / np.polyval(loop.denominator, s)
    phase = np.unwrap(np.angle(rational))
    # A loop with two integrators begins just above or just below -180 deg: bring it to the branch below zero.
    phase -= 2.0 * pi * np.ceil(phase[0] / (2.0 * pi) - 1e-9)
    return np.abs(rational), phase - omega_rad_s * loop.delay_s


def root_locus(loop: Loop, factors: FloatArray) -> NDArray[np.complex128]:
    """Closed-loop poles for the loop times each of ``factors`` (k,); shape (k, number of poles)."""
    whole = system(loop)
    import control  # noqa: PLC0415 - see ``system``

    loci: NDArray[np.complex128] = control.root_locus_map(whole, gains=factors).loci
    return loci


def _log_gain(omega_rad_s: float, loop: Loop) -> float:
    s = 1j * omega_rad_s
    return float(np.log(abs(np.polyval(loop.numerator, s) / np.polyval(loop.denominator, s))))


def _half_turn(omega_rad_s: float, loop: Loop) -> float:
    """Imaginary part of -L/|L|: zero, and changing its sign, where L is real."""
    s = 1j * omega_rad_s
    value = np.polyval(loop.numerator, s) / np.polyval(loop.denominator, s) * np.exp(-s * loop.delay_s)
    return float(-value.imag / abs(value))


def _changes(omega_rad_s: FloatArray, level: FloatArray) -> list[tuple[float, float]]:
    """The intervals of the grid over which ``level`` changes."""
    at = np.flatnonzero(np.diff(level))
    return [(float(omega_rad_s[i]), float(omega_rad_s[i + 1])) for i in at]


def _root(loop: Loop, of: Callable[[float, Loop], float], low: float, high: float) -> float:
    return float(brentq(of, low, high, args=(loop,)))


def _wrapped(angle_rad: float) -> float:
    """Into (-pi, pi]."""
    return -wrap_pi(-angle_rad)


def _trimmed(coefficients: Coefficients) -> Coefficients:
    """Without leading zeros."""
    first = next((i for i, c in enumerate(coefficients) if c != 0.0), len(coefficients) - 1)
    return coefficients[first:]
