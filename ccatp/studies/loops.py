"""The study `loops`: Bode plots, margins and root loci of the controllers, as in figs 3.6 to 3.9 of the thesis.

The thesis analyses its two loops with the plant 1/(T s + 1), from speed command to speed. The loops that are closed go
from speed command to position, with an additional integrator: 1/(s (T s + 1)). The study compares both, without and
with the delay of the link. Needs the extra ``tune`` (python-control), imported only when a system is built.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from math import degrees, inf, isfinite, pi, sqrt, tau
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ccatp.config.models import Config, ControlConfig, LimitsConfig, PidConfig
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi
from ccatp.report.plots import INK, QUIET
from ccatp.studies.campaign import CampaignError
from ccatp.studies.results import plot, write_analysis

if TYPE_CHECKING:
    from control import TransferFunction

Coefficients = tuple[float, ...]
"""A polynomial in s, highest power first."""

DELAYS_FRAMES = (0, 2, 4)  # link delay in both directions: none, that of the world `hard`, that of `extreme`
LIMIT_LAGS = (0.5, 0.25, 0.1, 0.01, 0.001)  # times the wheel servo's lag: towards the limit T -> 0
OMEGA_RAD_S = (1e-4, 300.0)  # the controller samples at 100 Hz, so the Nyquist frequency is 314 rad/s
GRID_POINTS = 4001
# Pade order of the delay, for poles and step responses only: accurate to 1e-5 rad up to 2 rad per delay.
PADE_ORDER = 4


@dataclass(frozen=True, slots=True)
class Loop:
    """One open loop L(s) = C(s) P(s) exp(-s tau)."""

    gains: str
    axis: str  # forward (distance, m), angular (turn in place, rad) or steering (heading on a leg, rad)
    plant: str  # ``printed`` is 1/(T s + 1), ``true`` 1/(s (T s + 1))
    lag_s: float
    delay_frames: int
    delay_s: float  # tau
    numerator: Coefficients
    denominator: Coefficients


class Margins(NamedTuple):
    """Stability margins of a loop; ``inf`` if there is no limit."""

    gain_db: float  # change of gain that makes the loop unstable; negative if a smaller gain does
    phase_rad: float  # smallest absolute value over all gain crossovers
    modulus: float  # smallest distance of L(j w) from -1
    gain_crossover_rad_s: float
    phase_crossover_rad_s: float
    delay_s: float
    is_stable: bool


def controller(gains: PidConfig, is_filtered: bool) -> tuple[Coefficients, Coefficients]:
    """Numerator and denominator of C(s) = Kp + Ki/s + Kd s/(Tf s + 1), thesis eq. 3.4 with Tf = 0 unless filtered."""
    filter_s = gains.derivative_filter_s if is_filtered and gains.kd else 0.0
    numerator: Coefficients = (gains.kd + filter_s * gains.kp, gains.kp + filter_s * gains.ki, gains.ki)
    denominator: Coefficients = (filter_s, 1.0, 0.0)
    if gains.ki == 0.0:  # avoids that a pole and a zero at the origin cancel
        numerator, denominator = numerator[:2], denominator[:2]
    return tuple(np.trim_zeros(numerator, "f")) or (0.0,), tuple(np.trim_zeros(denominator, "f"))


def steering(limits: LimitsConfig, control: ControlConfig) -> PidConfig:
    """The line-following controller as a controller of the heading, at full speed.

    Its law omega = -g v e - k theta, with k = sqrt(w + 2 g v^2) and e' = v theta, is C(s) = k + g v^2 / s.
    """
    pull = control.cross_track_gain_rad_m2 * limits.v_max_m_s**2
    kp = sqrt(control.heading_weight_1_s2 + 2.0 * pull)
    return PidConfig(kp=kp, ki=pull, kd=0.0, derivative_filter_s=0.0, integral_limit=0.0)


def open_loop(
    name: str, axis: str, gains: PidConfig, plant: str, lag_s: float, delay_frames: int, frame_s: float,
    *, is_filtered: bool = False,
) -> Loop:  # fmt: skip
    """Loop of one controller on one plant, its derivative filtered or not.

    The sampling of the controller is left out: its hold is half a frame, two degrees at the fastest crossover here. The
    prediction over commands that are not executed yet is also left out: the margins with a delay are those without it.
    """
    numerator, denominator = controller(gains, is_filtered)
    servo = (lag_s, 1.0, 0.0) if plant == "true" else (lag_s, 1.0)
    whole = tuple(float(c) for c in np.polymul(denominator, servo))
    return Loop(name, axis, plant, lag_s, delay_frames, delay_frames * frame_s, numerator, whole)


def loops_of(cfg: Config) -> Iterator[Loop]:
    """Each set of gains, axis, plant and delay; unshaped sets also on the printed plant, as analysed in the thesis.

    A shaped set has a feed-forward and feeds the tracking error back: the loop is that of its gains alone, without a
    derivative filter, because the estimate contains the speed. On a leg ``steering`` follows the line.
    """
    frame_s = 1.0 / cfg.sim.robot.frame_hz
    lag_s = cfg.robot.wheel_lag_s
    for name, gains in cfg.control.gain_sets.items():
        axes = {"forward": gains.forward, "angular": gains.angular}
        if gains.shaped:
            axes["steering"] = steering(cfg.limits, cfg.control)
        plants = ("true",) if gains.shaped else ("printed", "true")
        for (axis, pid), plant, frames in product(axes.items(), plants, DELAYS_FRAMES):
            is_filtered = plant == "true" and not gains.shaped  # printed: as in eq. 3.4; true: as implemented
            yield open_loop(name, axis, pid, plant, lag_s, frames, frame_s, is_filtered=is_filtered)


def limit_of(cfg: Config) -> Iterator[Loop]:
    """The printed loops of the unshaped sets as the lag goes to zero: the origin of the thesis's phase margin."""
    for name, gains in cfg.control.gain_sets.items():
        if not gains.shaped:
            for axis, pid in (("forward", gains.forward), ("angular", gains.angular)):
                for part in LIMIT_LAGS:
                    yield open_loop(name, axis, pid, "printed", part * cfg.robot.wheel_lag_s, 0, 0.0)


def _control() -> Any:
    try:
        import control  # noqa: PLC0415 - takes seconds, and belongs to an extra
    except ImportError as error:
        raise CampaignError("the loops study needs python-control: install ccatp[tune]") from error
    return control


def system(loop: Loop) -> "TransferFunction":
    """L(s) with the delay as a Pade approximant. Raises CampaignError: python-control is not installed."""
    control = _control()
    rational = control.TransferFunction(loop.numerator, loop.denominator)
    if loop.delay_s == 0.0:
        return rational
    return rational * control.TransferFunction(*control.pade(loop.delay_s, PADE_ORDER))


def margins(loop: Loop) -> Margins:
    """Margins of the closed loop L/(1 + L) with the exact delay, for frequencies in ``OMEGA_RAD_S``."""
    omega = np.geomspace(*OMEGA_RAD_S, GRID_POINTS)
    magnitude, phase = response(loop, omega)

    def crossings(of: Callable[[float, Loop], float], level: FloatArray) -> list[float]:
        """Roots of ``of`` between the frequencies of the grid at which ``level`` changes."""
        at = np.flatnonzero(np.diff(level))
        return [float(brentq(of, omega[i], omega[i + 1], args=(loop,))) for i in at]

    at_gain = crossings(_log_gain, np.sign(np.log(magnitude)))
    at_phase = crossings(_half_turn, np.floor((phase + pi) / (2.0 * pi)))
    phases = [(-wrap_pi(-(float(response(loop, np.array([w]))[1][0]) + pi)), w) for w in at_gain]
    gains = [(-20.0 * _log_gain(w, loop) / np.log(10.0), w) for w in at_phase]
    phase_rad, gain_crossover = min(phases, key=lambda pair: abs(pair[0]), default=(inf, inf))
    gain_db, phase_crossover = min(gains, key=lambda pair: abs(pair[0]), default=(inf, inf))
    spare_s = min(((angle % tau) / w for angle, w in phases), default=inf)
    modulus = float(np.abs(1.0 + magnitude * np.exp(1j * phase)).min())
    return Margins(float(gain_db), phase_rad, modulus, gain_crossover, phase_crossover, spare_s, is_stable(loop))


def is_stable(loop: Loop) -> bool:
    """Whether every pole of L/(1 + L) has a negative real part (the delay as a Pade approximant)."""
    return bool((_control().feedback(system(loop), 1).poles().real < 0.0).all())


def overshoot(loop: Loop) -> float:
    """Overshoot of the closed loop's unit step, as a fraction; ``inf`` if the loop is unstable."""
    if not is_stable(loop):
        return inf
    # The peak occurs within a few radians of the crossover frequency; forty include a slowly decaying tail.
    time_s = np.linspace(0.0, 40.0 / margins(loop).gain_crossover_rad_s, 4001)
    value = _control().step_response(_control().feedback(system(loop), 1), time_s).outputs
    return max(0.0, float(value.max()) - 1.0)


def response(loop: Loop, omega_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Magnitude and continuous phase (rad) of L(j omega) with the exact delay, both of shape (k,)."""
    rational = _rational(loop, 1j * omega_rad_s)
    phase = np.unwrap(np.angle(rational))
    # A loop with two integrators begins close to -180 deg, above or below: use the branch below zero.
    phase -= 2.0 * pi * np.ceil(phase[0] / (2.0 * pi) - 1e-9)
    return np.abs(rational), phase - omega_rad_s * loop.delay_s


def root_locus(loop: Loop, factors: FloatArray) -> NDArray[np.complex128]:
    """Closed-loop poles for the loop times each of ``factors`` (k,); shape (k, number of poles)."""
    loci: NDArray[np.complex128] = _control().root_locus_map(system(loop), gains=factors).loci
    return loci


def _rational(loop: Loop, s: Any) -> Any:
    return np.polyval(loop.numerator, s) / np.polyval(loop.denominator, s)


def _log_gain(omega_rad_s: float, loop: Loop) -> float:
    return float(np.log(abs(_rational(loop, 1j * omega_rad_s))))


def _half_turn(omega_rad_s: float, loop: Loop) -> float:
    """Imaginary part of -L/|L|: zero, with a change of sign, where L is real."""
    s = 1j * omega_rad_s
    value = _rational(loop, s) * np.exp(-s * loop.delay_s)
    return float(-value.imag / abs(value))


_COLOURS = {"printed": "#d08c00", "true": "#123f6d"}
_PLANTS = {"printed": "1/(Ts+1)", "true": "1/(s(Ts+1))"}
_DASHES = ("-", "--", ":")  # in order of the delays
_DECADES = (-2.0, 2.0)  # shown around the largest gain crossover, powers of ten
_FACTORS = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 1200)])  # factors on the loop gain, along a root locus
_WINDOW_CORNERS = 1.5  # the root locus shows this many times the servo's corner 1/T


def _draw_bode(loops: Sequence[Loop], found: Sequence[Margins], out: Path) -> None:
    """Magnitude and phase of the loops of one controller."""
    first, delays = loops[0], sorted({loop.delay_frames for loop in loops})
    crossovers = [m.gain_crossover_rad_s for m in found if np.isfinite(m.gain_crossover_rad_s)]
    centre = np.log10(max(crossovers, default=1.0))
    omega = np.geomspace(10.0 ** (centre + _DECADES[0]), 10.0 ** (centre + _DECADES[1]), 600)
    stem = out / f"bode_{first.gains}_{first.axis}"
    with plot(stem, 8.0, 6.4, 2, 1, grid="both", sharex=True) as (upper, lower):
        for loop, margin in zip(loops, found, strict=True):
            magnitude, phase = response(loop, omega)
            style = _DASHES[delays.index(loop.delay_frames) % len(_DASHES)]
            look = {"color": _COLOURS[loop.plant], "linestyle": style, "linewidth": 1.6}
            if loop.delay_frames == 0:  # a delay does not change the magnitude
                upper.semilogx(omega, 20.0 * np.log10(magnitude), **look)
            gain = f"{margin.gain_db:.0f} dB" if np.isfinite(margin.gain_db) else "∞"
            margin_text = f"{degrees(margin.phase_rad):.0f}°, {gain}"
            label = f"{_PLANTS[loop.plant]}, {loop.delay_frames} frames: {margin_text}"
            lower.semilogx(omega, np.degrees(phase), label=label, **look)
            if np.isfinite(margin.gain_crossover_rad_s):
                at = response(loop, np.geomspace(1e-4, margin.gain_crossover_rad_s, 400))[1][-1]
                lower.plot(margin.gain_crossover_rad_s, degrees(at), "o", color=_COLOURS[loop.plant], markersize=4)
        upper.axhline(0.0, color=QUIET, linewidth=0.8)
        lower.axhline(-180.0, color=QUIET, linewidth=0.8)
        lower.set_ylim(-290.0, 10.0)
        lower.set_yticks(range(-270, 1, 45))
        upper.set_ylabel("magnitude, dB")
        lower.set(xlabel="frequency, rad/s", ylabel="phase, deg")
        upper.set_title(f"Open loop, {first.axis}, gains “{first.gains}”, T = {first.lag_s:g} s")
        lower.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=False, fontsize=8)


def _draw_locus(loops: Sequence[Loop], out: Path) -> None:
    """Root loci of one controller for each plant, without and with the longest delay."""
    first = loops[0]
    ends = {min(loop.delay_frames for loop in loops), max(loop.delay_frames for loop in loops)}
    shown = [loop for loop in loops if loop.delay_frames in ends]
    title = f"Root locus, {first.axis}, gains “{first.gains}”, T = {first.lag_s:g} s"
    stem, width = out / f"rlocus_{first.gains}_{first.axis}", 3.6 * len(shown)
    with plot(stem, width, 5.6, 1, len(shown), title=title, legend=4, grid="both") as panels:
        for axes, loop in zip(panels, shown, strict=True):
            loci, closed = root_locus(loop, _FACTORS), root_locus(loop, np.array([1.0]))[0]
            zeros, poles, shade = np.roots(loop.numerator), np.roots(loop.denominator), _COLOURS[loop.plant]
            axes.plot(loci.real, loci.imag, ".", color=shade, markersize=1.5)
            axes.plot(poles.real, poles.imag, "x", color=INK, markersize=8, label="open-loop pole")
            axes.plot(zeros.real, zeros.imag, "o", color=INK, markersize=8, fillstyle="none", label="open-loop zero")
            axes.plot(
                closed.real, closed.imag, "s", color=shade, markersize=5, label="closed-loop pole at the set gain"
            )
            axes.axvspan(0.0, 1e4, color="#d64545", alpha=0.06, linewidth=0, label="unstable")
            size, title = _WINDOW_CORNERS / loop.lag_s, f"{_PLANTS[loop.plant]}, {loop.delay_frames} frames of delay"
            axes.set(xlim=(-size, 0.4 * size), ylim=(-size, size), xlabel="real part, 1/s", aspect="equal", title=title)
        panels[0].set_ylabel("imaginary part, 1/s")


COLUMNS = """
    gain_margin_db phase_margin_deg gain_crossover_rad_s delay_margin_s modulus_margin overshoot_percent
"""


def run(cfg: Config, out: Path) -> dict[str, Any]:
    """Analyse every loop of the configuration and write all files; a cell is one loop; infinite margins are None.

    Raises CampaignError: python-control is not installed.
    """
    started_s = time.perf_counter()
    loops = list(loops_of(cfg))
    found = {loop: margins(loop) for loop in (*loops, *limit_of(cfg))}
    cells = [_cell(loop, each) for loop, each in found.items()]
    for _, alike in groupby(loops, key=lambda loop: (loop.gains, loop.axis)):
        group = list(alike)
        _draw_bode(group, [found[loop] for loop in group], out)
        _draw_locus(group, out)
    omega = np.geomspace(*OMEGA_RAD_S, GRID_POINTS)
    magnitude, phase = (np.array(part) for part in zip(*(response(loop, omega) for loop in loops), strict=True))
    names = np.array([f"{loop.gains}/{loop.axis}/{loop.plant}/{loop.delay_frames}" for loop in loops])
    arrays = {"omega_rad_s": omega, "loop": names, "magnitude": magnitude, "phase_rad": phase}
    return write_analysis("loops", cells, COLUMNS, out, started_s, arrays=arrays)


def _cell(loop: Loop, found: Margins) -> dict[str, Any]:
    figures = {
        "gain_margin_db": found.gain_db,
        "phase_margin_deg": degrees(found.phase_rad),
        "modulus_margin": found.modulus,
        "gain_crossover_rad_s": found.gain_crossover_rad_s,
        "phase_crossover_rad_s": found.phase_crossover_rad_s,
        "delay_margin_s": found.delay_s,
        "overshoot_percent": 100.0 * overshoot(loop),
    }
    return {
        **{name: getattr(loop, name) for name in ("gains", "axis", "plant", "lag_s", "delay_frames")},
        "runs": 1,
        "is_stable": found.is_stable,
        **{name: value if isfinite(value) else None for name, value in figures.items()},
    }
