"""Glue. The main loop's parts and the mission's database, new or resumed."""

from collections.abc import Sequence

from ccatp.assembly import Parts, assemble
from ccatp.errors import CcatpError, ExitStatus
from ccatp.mirror.mirror import build_mirror
from ccatp.planning.traversal import ORDERS
from ccatp.processes.common import ProcessArgs
from ccatp.samples import PointId
from ccatp.store import MissionStore, PlannedPoint, StoreError


class StoreUnusable(CcatpError):
    """The mission's database cannot be made or read."""

    exit_status = ExitStatus.USAGE


def build_parts(args: ProcessArgs) -> tuple[Parts, MissionStore]:
    """All parts of the main loop and the mission's database."""
    cfg = args.config
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        store = _open_store(args, mirror.name, points)
    except StoreError as error:
        raise StoreUnusable(str(error)) from error
    return assemble(cfg, store.measured_points()), store


def _open_store(args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path = args.run_dir / "mission.sqlite"
    if args.is_resuming:
        return MissionStore.open(path, mirror=mirror)
    cfg = args.config
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(PlannedPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned)
