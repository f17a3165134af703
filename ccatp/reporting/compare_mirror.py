"""Pure. Two runs on one mirror: their paths, the points that ended otherwise, surfaces, panels, adjusters."""

from functools import partial

from ccatp.aligning.panel_result import PanelResult
from ccatp.drawing.shapes import Picture
from ccatp.reporting.compare_figures import Draw, change_figure, paths_figure
from ccatp.reporting.html import NARROW, beside, figure, folded, shown, table, text
from ccatp.reporting.page import Section
from ccatp.reporting.pair import Pair
from ccatp.reporting.panel_changes import PanelChange
from ccatp.reporting.path_figure import point_text
from ccatp.reporting.surface_figure import surface_figure
from ccatp.samples import PanelId

_MICRO = 1e6
_FEW = 12


def paths_section(pair: Pair) -> Section | None:
    """The mirror with both paths."""
    draw = paths_drawing(pair)
    return None if draw is None else Section("map", "Paths", figure(draw, "True paths where they are known."))


def paths_drawing(pair: Pair) -> Draw | None:
    """What draws both paths; None where there are none, or of different mirrors."""
    records = {letter: found.record for letter, found in pair.named if found.record.sessions}
    return partial(paths_figure, pair.b.record.mirror, records) if pair.is_one_mirror and records else None


def points_section(pair: Pair) -> Section | None:
    """Points that ended otherwise."""
    if not pair.is_one_mirror or not (pair.a.points and pair.b.points):
        return None
    a = {verdict.point: verdict for verdict in pair.a.points}
    both = [(a[verdict.point], verdict) for verdict in pair.b.points if verdict.point in a]
    rows = [
        [point_text(one.point), str(one.grade), str(other.grade), shown(one.first_mm), shown(other.first_mm)]
        for one, other in both
        if one.grade is not other.grade
    ]
    only = f"<p>{len(both)} points are in both missions.</p>"
    head = ["point", "A", "B", "first in A, mm", "first in B, mm"]
    return Section("points", "Points", only + (table(head, rows) if rows else "<p>All ended the same way.</p>"))


def surfaces_section(pair: Pair) -> Section | None:
    """Both surfaces in the same colours."""
    drawn = _surfaces(pair) if pair.is_one_mirror else []
    if not drawn:
        return None
    return Section("surface", "Surfaces", beside(drawn) + "<p>Both in the same colours.</p>")


def _surfaces(pair: Pair) -> list[tuple[str, Picture]]:
    mirror, known = pair.b.record.mirror, [(n, f.alignment.panels) for n, f in pair.named if f.alignment is not None]
    everything = [panel for _, panels in known for panel in panels]
    return [
        (name, surface_figure(mirror, panels, f"{mirror.name}: surface of {name}", NARROW, scaled_as=everything))
        for name, panels in known
        if panels
    ]


def panels_section(pair: Pair) -> Section | None:
    """Which panels have moved."""
    changes, draw = pair.changes, change_drawing(pair)
    if changes is None or draw is None:
        return None
    moved = [panel for panel in changes.panels if panel.has_moved]
    verdict = "The surveys agree" if changes.agree else f"{len(moved)} of {len(changes.panels)} panels have moved"
    lead = (
        f"<p><strong>{verdict}</strong>: \u03c7\u00b2 of no change {changes.chi2:.1f} for {changes.dof} degrees of "
        f"freedom; noise alone keeps it between {changes.low:.1f} and {changes.high:.1f} (99 %).</p>"
    )
    rows = [_change(panel) for panel in sorted(changes.panels, key=lambda panel: -panel.chi2)]
    head = ["panel", "piston, \u00b5m", "tip, \u00b5rad", "tilt, \u00b5rad", "\u03c7\u00b2 (3)", ""]
    return Section("panels", "Panels, B less A", lead + figure(draw, "") + _few(head, rows))


def _change(panel: PanelChange) -> list[str]:
    pairs = zip(panel.values.tolist(), panel.sigma.tolist(), strict=True)
    cells = [f"{shown(_MICRO * value, 1)} \u00b1 {shown(_MICRO * sigma, 1)}" for value, sigma in pairs]
    return [f"{panel.panel.row}/{panel.panel.col}", *cells, shown(panel.chi2, 1), "moved" if panel.has_moved else ""]


def change_drawing(pair: Pair) -> Draw | None:
    """What draws the change of the surface."""
    if pair.changes is None or pair.a.alignment is None or pair.b.alignment is None:
        return None
    return partial(change_figure, pair.b.record.mirror, pair.a.alignment.panels, pair.b.alignment.panels)


def adjusters_section(pair: Pair) -> Section | None:
    """The moves that each survey asks for; those of B are still to be made."""
    if not pair.is_one_mirror:
        return None
    a, b = (_by_panel(found.alignment.panels if found.alignment else ()) for _, found in pair.named)
    panels = sorted({*a, *b}, key=lambda panel: (-_largest(b.get(panel)), panel))
    if not panels:
        return None
    names = next(iter((b or a).values())).adjusters
    rows = []
    for panel in panels:
        one, other = (_moves(found.get(panel), len(names)) for found in (a, b))
        moves = (f"{first} \u2192 <strong>{then}</strong>" for first, then in zip(one, other, strict=True))
        rows.append([f"{panel.row}/{panel.col}", *moves])
    lead = (
        "<p>Moves of the vertical adjusters in \u00b5m, positive towards the robot: those that A asks for \u2192 those "
        "that B asks for, which are <strong>still to be made</strong>.</p>"
    )
    return Section("adjusters", "Adjuster moves", lead + _few(["panel", *names], rows, "dense"))


def _by_panel(panels: tuple[PanelResult, ...]) -> dict[PanelId, PanelResult]:
    return {panel.panel: panel for panel in panels}


def _largest(panel: PanelResult | None) -> float:
    return 0.0 if panel is None else float(abs(panel.rigid.moves.values_m).max())


def _moves(panel: PanelResult | None, count: int) -> list[str]:
    if panel is None:
        return [shown(None)] * count
    return [shown(float(move) * _MICRO, 1) for move in panel.rigid.moves.values_m]


def _few(head: list[str], rows: list[list[str]], kind: str = "") -> str:
    """The first rows, and under a line all of them."""
    whole = folded(text(f"All {len(rows)} panels"), table(head, rows, kind)) if len(rows) > _FEW else ""
    return table(head, rows[:_FEW], kind) + whole
