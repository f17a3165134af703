"""Edge. Figures of signal strengths: path loss with its confidence, fixes with their regions, the fuzzy speed.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from ccatp.config.radio_models import FuzzyConfig
from ccatp.control.fuzzy import Sugeno
from ccatp.pictures.figures import INK, QUIET, dress, new_figure, save_figure
from ccatp.radio.level_fix import LevelFix
from ccatp.radio.path_loss_fit import LevelPair, PathLossFit

_BLUE, _GOLD, _GREEN, _RED = "#0b3c5d", "#d08c00", "#1d9a8a", "#c0392b"
_REGION = 0.9


def draw_path_loss(fit: PathLossFit, pairs: Sequence[LevelPair], name: str, out: Path) -> None:
    """Levels over distance, the line, and where 95 % of new places are expected.

    Raises:
        PictureError: the file cannot be written.
    """
    figure = new_figure(7.0, 4.4)
    axes = figure.subplots()
    distances, levels = np.array([pair[:2] for pair in pairs]).T
    grid = np.geomspace(distances.min() / 1.2, distances.max() * 1.2, 200)
    mean, scale = fit.predicted(grid)
    half = scale * float(stdtrit(fit.freedom, 0.975))
    axes.fill_between(grid, mean - half, mean + half, color=_BLUE, alpha=0.12, linewidth=0, label="95 % of new places")
    axes.plot(grid, mean, color=_BLUE, linewidth=1.6, label=_formula(fit))
    axes.plot(distances, levels, "o", color=_GOLD, markersize=4, markeredgecolor="white", label="readings")
    axes.set(xscale="log", xlabel="distance, m", ylabel="level, dBm", title=name)
    axes.xaxis.set_major_formatter("{x:g}")
    dress(axes)
    axes.legend(frameon=False, fontsize=8)
    save_figure(figure, out)


def draw_fixes(
    fixes: Sequence[LevelFix], truths: Sequence[tuple[float, float]], beacons_m: Mapping[str, tuple[float, float]],
    name: str, out: Path,
) -> None:  # fmt: skip
    """A panel for each point (at most twelve): its 90 % region, the fix, and where it was.

    Raises:
        PictureError: the file cannot be written.
    """
    shown = list(zip(fixes, truths, strict=True))[:12]
    columns = min(5, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(2.3 * columns, 2.3 * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for index, (axes, (fix, truth)) in enumerate(zip(panels, shown, strict=False), 1):
        inside = fix.points_m[fix.region(_REGION)]
        axes.plot(*inside.T, "s", color=_BLUE, alpha=0.18, markersize=2.2, markeredgewidth=0, label="90 % region")
        axes.plot(*np.array(list(beacons_m.values())).T, "^", color=QUIET, markersize=5, label="beacons")
        axes.plot(*truth, "x", color=_RED, markersize=6, markeredgewidth=1.6, label="truth")
        axes.plot(*fix.position_m, "o", color=_GOLD, markersize=5, markeredgecolor="white", label="fix")
        error_m = float(np.hypot(*(fix.position_m - truth)))
        axes.set_title(f"{index}: {error_m:.2f} m")
        axes.set_aspect("equal")
        dress(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle(name, fontsize=10, color=INK)
    save_figure(figure, out)


def draw_fuzzy(cfg: FuzzyConfig, out: Path) -> None:
    """The speed over distance and heading error, and the memberships of both.

    Raises:
        PictureError: the file cannot be written.
        FuzzyGapError: the rules leave a gap.
    """
    sugeno = Sugeno(cfg)
    figure = new_figure(10.0, 4.6)
    layout = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
    spans = [_span(cfg, name) for name in sugeno.inputs]
    x, y = (np.linspace(*span, 121) for span in spans)
    speed = np.array([[sugeno.evaluate((a, b)) for a in x.tolist()] for b in y.tolist()])
    axes = figure.add_subplot(layout[:, 0])
    in_degrees = [name.endswith("_rad") for name in sugeno.inputs]
    shown_x, shown_y = (np.degrees(v) if is_angle else v for v, is_angle in zip((x, y), in_degrees, strict=True))
    drawn = axes.contourf(shown_x, shown_y, speed, levels=np.linspace(speed.min(), speed.max(), 25), cmap="viridis")
    lines = axes.contour(shown_x, shown_y, speed, levels=6, colors="white", linewidths=0.6)
    axes.clabel(lines, fmt="%.2f", fontsize=7)
    axes.set(xlabel=_label(sugeno.inputs[0]), ylabel=_label(sugeno.inputs[1]), title="speed, m/s")
    figure.colorbar(drawn, ax=axes, format="%.2f")
    for row, (name, span) in enumerate(zip(sugeno.inputs, spans, strict=True)):
        panel = figure.add_subplot(layout[row, 1])
        values = np.linspace(*span, 200)
        grades = np.array([sugeno.memberships(row, value) for value in values.tolist()])
        for index, term in enumerate(cfg.inputs[name].terms):
            colour = (_BLUE, _GOLD, _GREEN, _RED, QUIET)[index % 5]
            panel.plot(np.degrees(values) if in_degrees[row] else values, grades[:, index], color=colour, label=term)
        panel.set(xlabel=_label(name), ylim=(-0.03, 1.08))
        panel.legend(frameon=False, fontsize=8, loc="center right")
        dress(panel)
    axes.tick_params(labelsize=8, color=QUIET, labelcolor=INK)
    save_figure(figure, out)


def _formula(fit: PathLossFit) -> str:
    reference, exponent = fit.half_widths(0.95)
    return (
        f"{fit.reference_dbm:.1f} ± {reference:.1f} dBm at 1 m, exponent {fit.exponent:.2f} ± {exponent:.2f}, "
        f"spread {fit.sigma_db:.1f} dB"
    )


def _span(cfg: FuzzyConfig, name: str) -> tuple[float, float]:
    """From nought to a quarter beyond the last corner that is not far away on purpose."""
    corners = [corner for term in cfg.inputs[name].terms.values() for corner in term]
    top = 1.25 * max(term[1] for term in cfg.inputs[name].terms.values())
    return max(0.0, min(corners)), top


def _label(name: str) -> str:
    words = name.replace("_", " ")
    return words.removesuffix(" rad") + ", deg" if name.endswith("_rad") else words.removesuffix(" m") + ", m"
