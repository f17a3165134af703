"""Pure. The table of panels: how each lies, and how to turn its adjusters."""

from collections.abc import Iterable, Sequence

from ccatp.aligning.modes import FloatArray
from ccatp.aligning.panel_result import PanelResult
from ccatp.aligning.wavefront import mirror_wavefront
from ccatp.reporting.findings import Findings
from ccatp.reporting.html import folded, listed, shown, table, text
from ccatp.reporting.page import Section

_MICRO = 1e6
_FEW = 12


def panel_section(found: Findings) -> Section | None:
    """One row a panel."""
    alignment = found.alignment
    if alignment is None or not (alignment.panels or alignment.undetermined):
        return None
    lead = (
        "<p>Piston, tip and tilt with their standard deviations; moves of the vertical adjusters in \u00b5m, positive "
        "towards the robot; half-wavefront error of the panel before and after the moves. All pistons share an "
        f"uncertainty of {_um(found.record.cfg.align.puck_height_sigma_m)} \u00b5m, the puck's height.</p>"
    )
    body = lead
    if alignment.panels:
        names = alignment.panels[0].adjusters
        few = sorted(alignment.panels, key=_before_m, reverse=True)[:_FEW]
        if len(few) < len(alignment.panels):
            whole = folded(f"All {len(alignment.panels)} panels", _table(names, alignment.panels))
            body += "<h3>The furthest from where they should be</h3>" + _table(names, few) + whole
        else:
            body += _table(names, alignment.panels)
    others = [f"{one.panel.row}/{one.panel.col}: {one.why}" for one in alignment.undetermined]
    if others:
        body += folded(f"{len(others)} panels not determined", listed(others))
    return Section("panels", "Panels and adjusters", body)


def _table(names: Sequence[str], panels: Sequence[PanelResult]) -> str:
    head = ["panel", "points", "piston, \u00b5m", "tip, \u00b5rad", "tilt, \u00b5rad", "\u03c7\u00b2/dof"]
    remarks = [_remarks(panel) for panel in panels]
    rows = [[*_row(panel), text(remark)] for panel, remark in zip(panels, remarks, strict=True)]
    columns = [*head, *names, "before, \u00b5m", "after, \u00b5m", "remarks"]
    if not any(remarks):
        return table(columns[:-1], [row[:-1] for row in rows], "dense")
    return table(columns, rows, "dense")


def _row(panel: PanelResult) -> list[str]:
    wavefront = mirror_wavefront([panel.rigid.wavefront])
    before, after = (shown(None),) * 2 if wavefront is None else map(_um, (wavefront.before_m, wavefront.after_m))
    return [
        f"{panel.panel.row}/{panel.panel.col}",
        text(int(panel.is_kept.sum())),
        *_with_sigma(panel.fit.values, panel.fit.sigma),
        f"{panel.fit.chi2:.1f}/{panel.fit.dof}",
        *(_um(move) for move in panel.rigid.moves.values_m),
        before,
        after,
    ]


def _before_m(panel: PanelResult) -> float:
    found = mirror_wavefront([panel.rigid.wavefront])
    return 0.0 if found is None else found.before_m


def _with_sigma(values: FloatArray, sigmas: FloatArray) -> Iterable[str]:
    return (f"{_um(value)} \u00b1 {_um(sigma)}" for value, sigma in zip(values, sigmas, strict=True))


def _um(value: float) -> str:
    return shown(float(value) * _MICRO, 1)


def _remarks(panel: PanelResult) -> str:
    found = []
    if panel.outliers:
        found.append("left out: " + ", ".join(str(point.point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        found.append("bent")
    return "; ".join(found)
