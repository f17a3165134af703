"""Pure. The alignment as text for a terminal."""

from collections.abc import Iterator, Sequence
from typing import Any

from ccatp.aligning.comparison import Comparison
from ccatp.aligning.modes import FloatArray
from ccatp.aligning.panel_result import PanelResult
from ccatp.aligning.survey_result import SurveyResult, Undetermined, point_text

_MICRO = 1e6
_SHOWN = 12  # panels without a result that are named


def table_lines(result: SurveyResult, comparison: Comparison | None, puck_height_sigma_m: float) -> Iterator[str]:
    """One line a panel, then the mirror.

    Args:
        result: the alignment.
        comparison: against the simulated truth, if there is one.
        puck_height_sigma_m: uncertainty that all pistons share.
    """
    if result.panels:
        yield from _panels(result.panels)
        yield ""
    yield from _undetermined(result.undetermined)
    if result.wavefront is not None:
        found = result.wavefront
        yield f"half-wavefront error  {_um(found.before_m)} um rms, {_um(found.before_level_m)} without its mean"
        bent = result.wavefront_bent
        extra = "" if bent is None else f", {_um(bent.after_m)} with moves that bend, too"
        yield f"  after the moves     {_um(found.after_m)} um rms predicted{extra}"
        yield f"  one point           {_um(found.noise_m)} um of measurement noise"
        yield f"pistons share         {_um(puck_height_sigma_m)} um, the uncertainty of the puck's height"
    if comparison is not None:
        yield from _comparison(comparison)


def _panels(panels: Sequence[PanelResult]) -> Iterator[str]:
    names = panels[0].adjusters
    head = f"{'panel':<6}{'points':>7}{'piston um':>16}{'tip urad':>16}{'tilt urad':>16}{'chi2/dof':>12}  "
    yield head + "".join(f"{name:>8}" for name in names) + "   moves, um (> 0 towards the robot)"
    for panel in panels:
        fit = "".join(f"{cell:>16}" for cell in _with_sigma(panel.fit.values, panel.fit.sigma))
        kept = int(panel.is_kept.sum())
        where = f"{panel.panel.row}/{panel.panel.col}"
        moves = "".join(f"{_MICRO * move:>8.1f}" for move in panel.rigid.moves.values_m)
        line = f"{where:<6}{kept:>7}{fit}{panel.fit.chi2:>8.1f}/{panel.fit.dof:<3}  {moves}   {_notes(panel)}"
        yield line.rstrip()


def _notes(panel: PanelResult) -> str:
    notes = []
    if panel.outliers:
        notes.append("left out: " + " ".join(point_text(point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        xx, xy, yy = (f"{_MICRO * value:.0f}" for value in panel.shape.values_1_m)
        notes.append(f"bent: xx {xx}, xy {xy}, yy {yy} um/m^2")
    return "; ".join(notes)


def _with_sigma(values: FloatArray, sigmas: FloatArray) -> list[str]:
    pairs = zip(values, sigmas, strict=True)
    return [f"{_MICRO * value:.1f} +- {_MICRO * sigma:.1f}" for value, sigma in pairs]


def _undetermined(others: Sequence[Undetermined]) -> Iterator[str]:
    begun = [one for one in others if one.points]
    for one in begun[:_SHOWN]:
        yield f"panel {one.panel.row}/{one.panel.col} not determined: {one.why}"
    if len(begun) > _SHOWN:
        yield f"and {len(begun) - _SHOWN} more panels not determined"
    if count := len(others) - len(begun):
        yield f"{count} panel{'' if count == 1 else 's'} not measured"
    if others:
        yield ""


def _comparison(found: Comparison) -> Iterator[str]:
    tilt = f"tip and tilt {_um(found.tilt_rms_rad)} urad rms"
    yield f"against the truth     piston {_um(found.piston_rms_m)} um rms, {tilt}"
    verdict = "inside" if found.agrees else "OUTSIDE"
    band = f"{verdict} its 99 % band of {found.low:.1f} to {found.high:.1f}"
    yield f"  chi2 of {found.panels} panels{'':<2}{found.chi2:.1f} for {found.dof} degrees of freedom, {band}"


def _um(value: float) -> str:
    return f"{_MICRO * value:.2f}"


def head_lines(facts: dict[str, Any]) -> Iterator[str]:
    """What was analysed.

    Args:
        facts: run_dir, mirror, world, seed, points (total, measured), as in the JSON result.
    """
    where = "real robot" if facts["world"] is None else f"simulation, world {facts['world']}, seed {facts['seed']}"
    points = facts["points"]
    yield f"{facts['run_dir']}: {facts['mirror']}, {where}"
    yield f"{points['measured']} of {points['total']} points measured, {points['outliers']} of them left out"
    yield ""
