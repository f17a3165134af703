"""Edge. The figures of the study `loops`, as PNG and PDF.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from collections.abc import Sequence
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ccatp.studies.figures import INK, QUIET, dress, new_figure, save
from ccatp.studies.loop_models import Loop, Margins, response, root_locus

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {"printed": "#d08c00", "true": "#123f6d"}
_PLANTS = {"printed": "1/(Ts+1)", "true": "1/(s(Ts+1))"}
_DASHES = ("-", "--", ":")  # by the order of the delays
_DECADES = (-2.0, 2.0)  # shown around the largest gain crossover, powers of ten
_FACTORS = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 1200)])  # of the loop gain, along a root locus
_WINDOW_CORNERS = 1.5  # the root locus shows this many times the servo's corner 1/T


def draw_bode(loops: Sequence[Loop], margins: Sequence[Margins], out: Path) -> None:
    """Draw magnitude and phase of the loops of one controller into ``bode_<gains>_<axis>.png`` and ``.pdf``."""
    figure = new_figure(8.0, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    crossovers = [m.gain_crossover_rad_s for m in margins if np.isfinite(m.gain_crossover_rad_s)]
    centre = np.log10(max(crossovers, default=1.0))
    omega = np.geomspace(10.0 ** (centre + _DECADES[0]), 10.0 ** (centre + _DECADES[1]), 600)
    for loop, found in zip(loops, margins, strict=True):
        magnitude, phase = response(loop, omega)
        look = {"color": _COLOURS[loop.plant], "linestyle": _style(loops, loop), "linewidth": 1.6}
        if loop.delay_frames == 0:  # a delay leaves the magnitude as it is
            upper.semilogx(omega, 20.0 * np.log10(magnitude), **look)
        lower.semilogx(omega, np.degrees(phase), label=_label(loop, found), **look)
        if np.isfinite(found.gain_crossover_rad_s):
            at = response(loop, np.geomspace(1e-4, found.gain_crossover_rad_s, 400))[1][-1]
            lower.plot(found.gain_crossover_rad_s, degrees(at), "o", color=_COLOURS[loop.plant], markersize=4)
    upper.axhline(0.0, color=QUIET, linewidth=0.8)
    lower.axhline(-180.0, color=QUIET, linewidth=0.8)
    lower.set_ylim(-290.0, 10.0)
    lower.set_yticks(range(-270, 1, 45))
    upper.set_ylabel("magnitude, dB")
    lower.set_ylabel("phase, deg")
    lower.set_xlabel("frequency, rad/s")
    upper.set_title(f"Open loop, {loops[0].axis}, gains “{loops[0].gains}”, T = {loops[0].lag_s:g} s")
    lower.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=False, fontsize=8)
    dress(upper, lower, grid="both")
    save(figure, out / f"bode_{loops[0].gains}_{loops[0].axis}")


def draw_locus(loops: Sequence[Loop], out: Path) -> None:
    """Draw the root loci, each plant without and with the longest delay: ``rlocus_<gains>_<axis>.png`` and ``.pdf``.

    Raises:
        LoopsError: python-control is not installed.
    """
    ends = {min(loop.delay_frames for loop in loops), max(loop.delay_frames for loop in loops)}
    shown = [loop for loop in loops if loop.delay_frames in ends]
    figure = new_figure(3.6 * len(shown), 5.6)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, loop in zip(panels, shown, strict=True):
        _draw_poles(axes, loop)
    panels[0].set_ylabel("imaginary part, 1/s")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle(f"Root locus, {loops[0].axis}, gains “{loops[0].gains}”, T = {loops[0].lag_s:g} s")
    dress(*panels, grid="both")
    save(figure, out / f"rlocus_{loops[0].gains}_{loops[0].axis}")


def _draw_poles(axes: "Axes", loop: Loop) -> None:
    loci = root_locus(loop, _FACTORS)
    colour = _COLOURS[loop.plant]
    axes.plot(loci.real, loci.imag, ".", color=colour, markersize=1.5)
    zeros, poles, closed = np.roots(loop.numerator), np.roots(loop.denominator), root_locus(loop, np.array([1.0]))[0]
    axes.plot(poles.real, poles.imag, "x", color=INK, markersize=8, label="open-loop pole")
    axes.plot(zeros.real, zeros.imag, "o", color=INK, markersize=8, fillstyle="none", label="open-loop zero")
    axes.plot(closed.real, closed.imag, "s", color=colour, markersize=5, label="closed-loop pole at the set gain")
    axes.axvspan(0.0, 1e4, color="#d64545", alpha=0.06, linewidth=0, label="unstable")
    size = _WINDOW_CORNERS / loop.lag_s
    axes.set(xlim=(-size, 0.4 * size), ylim=(-size, size), xlabel="real part, 1/s", aspect="equal")
    axes.set_title(f"{_PLANTS[loop.plant]}, {loop.delay_frames} frames of delay", fontsize=9)


def _style(loops: Sequence[Loop], loop: Loop) -> str:
    delays = sorted({other.delay_frames for other in loops})
    return _DASHES[delays.index(loop.delay_frames) % len(_DASHES)]


def _label(loop: Loop, found: Margins) -> str:
    gain = f"{found.gain_db:.0f} dB" if np.isfinite(found.gain_db) else "∞"
    return f"{_PLANTS[loop.plant]}, {loop.delay_frames} frames: {degrees(found.phase_rad):.0f}°, {gain}"
