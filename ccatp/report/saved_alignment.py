"""Alignments that ``ccatp align --json`` wrote, read for a comparison: panels are fitted again to their deviations."""

from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pydantic

from ccatp.config.files import read_input
from ccatp.config.models import AlignConfig, MirrorConfig
from ccatp.core import PanelId, PointId
from ccatp.errors import UsageError
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.panel_alignment import PanelResult, panel_result
from ccatp.mirror.panel_explanations import Prices, prices
from ccatp.mirror.panel_modes import Deviations, surface_under
from ccatp.mirror.surface import ConvergenceError, MirrorError

_MOST_BYTES = 1 << 26  # a survey of 783 points, with the errors that they share by the laser network, is 3 MB
_MOST_DIFFERENCE_UM = 0.05  # of moves, by rounded deviations
_MAKE = "make it with: ccatp align ... --json >"


class AlignmentFileError(UsageError):
    """A file that is no alignment, or one that contradicts itself."""


class SavedAlignment(NamedTuple):
    """An alignment that was written. ``is_of_points``: of another instrument, in a frame of its own."""

    name: str
    cfg: MirrorConfig
    mirror: Mirror
    panels: tuple[PanelResult, ...]
    is_of_points: bool


class _Point(msgspec.Struct):
    point: int
    x_m: float
    y_m: float
    deviation_um: float
    sigma_um: float
    metrology: str
    readings: int
    common_um: list[float]


class _Panel(msgspec.Struct):
    row: int
    col: int
    cos_incidence: float
    adjusters_um: list[float]
    deviations: list[_Point]


class _Settings(msgspec.Struct):
    mirror: dict[str, Any]
    align: dict[str, Any]


class _Alignment(msgspec.Struct):
    panels: list[_Panel]
    config: _Settings | None = None
    points_file: str | None = None


def read_alignment(path: Path) -> SavedAlignment:
    """The panels of a written alignment; raises ``AlignmentFileError``."""
    try:
        data = read_input(path, _MOST_BYTES)
    except OSError as error:
        raise AlignmentFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        # A shell may write the standard output in UTF-16.
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
        found = msgspec.json.decode(text, type=_Alignment)
    except (UnicodeDecodeError, msgspec.DecodeError) as error:
        raise AlignmentFileError(
            f"{path}: neither a run directory nor an alignment; that of a file of points: "
            f"ccatp align --points {path} ... --json > {path.stem}.json"
        ) from error
    if found.config is None:
        raise AlignmentFileError(f"{path}: an alignment of an older version; {_MAKE} {path}")
    try:
        cfg = MirrorConfig.model_validate(found.config.mirror)
        align = AlignConfig.model_validate(found.config.align)
        mirror = build_mirror(cfg)
        price = prices(align.false_alarm, sum(len(panel.deviations) for panel in found.panels), len(found.panels))
        panels = tuple(_panel(path, mirror, panel, price) for panel in found.panels)
    except (pydantic.ValidationError, MirrorError, ConvergenceError) as error:
        raise AlignmentFileError(f"{path}: not as ccatp align writes it: {error}; {_MAKE} {path}") from error
    return SavedAlignment(path.name, cfg, mirror, panels, found.points_file is not None)


def _panel(path: Path, mirror: Mirror, saved: _Panel, price: Prices) -> PanelResult:
    """The panel fitted again; it must have the moves that were written, as those are what was carried out."""
    panel = PanelId(saved.row, saved.col)
    where = f"{path}: panel {panel.row}/{panel.col}"
    if panel not in mirror.panels:
        raise AlignmentFileError(f"{where} is none of {mirror.name}; {_MAKE} {path}")
    points = saved.deviations
    widths = {len(one.common_um) for one in points}
    result = None
    if len(widths) == 1 and all(one.sigma_um > 0.0 for one in points):
        places = [(one.x_m, one.y_m) for one in points]
        deck, normals = surface_under(mirror, panel, places)
        found = Deviations(
            points=tuple(PointId(panel.row, panel.col, one.point) for one in points),
            places_m=np.array(places),
            deck_m=deck,
            lever=normals @ np.array(mirror.panel(panel).axes[2]),
            values_m=1e-6 * np.array([one.deviation_um for one in points]),
            sigmas_m=1e-6 * np.array([one.sigma_um for one in points]),
            metrology=tuple(one.metrology for one in points),
            common=1e-6 * np.array([one.common_um for one in points]) if widths != {0} else None,
            readings=np.array([one.readings for one in points], dtype=np.float64),
        )
        result = panel_result(mirror, panel, found, price, saved.cos_incidence)
    moves = np.array(saved.adjusters_um)
    if (
        result is None
        or moves.shape != result.rigid.moves.values_m.shape
        or not np.allclose(1e6 * result.rigid.moves.values_m, moves, rtol=0.0, atol=_MOST_DIFFERENCE_UM)
    ):
        raise AlignmentFileError(
            f"{where}: its points do not give its moves: the file was changed, or is of another version; {_MAKE} {path}"
        )
    return result
