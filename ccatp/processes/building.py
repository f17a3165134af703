"""Glue. The main loop's parts and the mission's database, new, resumed, or taken over from a main loop that died."""

from collections.abc import Sequence

from ccatp.assembly import Parts, assemble
from ccatp.errors import CcatpError, ExitStatus
from ccatp.mirror.mirror import build_mirror
from ccatp.planning.traversal import ORDERS
from ccatp.processes.common import ProcessArgs
from ccatp.processes.keeping import recovery_from
from ccatp.processes.latching import FILE as EMERGENCIES
from ccatp.processes.latching import active_ids
from ccatp.samples import PointId
from ccatp.storage.store import MissionStore, PlannedPoint, StoreError
from ccatp.surveying.recovery import Recovery


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
    done = store.measured_points()
    recovery = _recovery(args, store, points, done)
    parts = assemble(cfg, done, recovery)
    if recovery is None and args.is_held:
        latched = [f"'ccatp clear {one}'" for one in active_ids(args.run_dir / EMERGENCIES)]
        before = f"the last run ended with an emergency that is not cleared: {', '.join(latched)}; " if latched else ""
        parts.mission.pause(before + _why_held(len(done), points))
        parts.mission.know_emergency()
    return parts, store


def _recovery(args: ProcessArgs, store: MissionStore, points: Sequence[PointId], done: set[PointId]) -> Recovery | None:
    if not args.is_taking_over:
        return None
    # A run that is resumed tries again what was skipped; a main loop that takes over does not.
    skipped = tuple(p.point for p in store.points() if p.status == "skipped") if args.is_restarted else ()
    left = [point for point in points if point not in done and point not in skipped]
    recovery = recovery_from(
        args.run_dir, args.config.limits, skipped, _why_held(len(done), left) if args.is_held else ""
    )
    return recovery if recovery is None or args.is_restarted else recovery._replace(elapsed_s=0.0)


def _why_held(done: int, left: Sequence[PointId]) -> str:
    goes_on = f"goes on with point {left[0].row}-{left[0].col}-{left[0].point}" if left else "ends it"
    measured = f"{done} points are measured and will be left out, {len(left)} are to do"
    return f"started anew: {measured}; 'ccatp resume' {goes_on}"


def _open_store(args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path = args.run_dir / "mission.sqlite"
    if args.is_resuming or (args.is_restarted and path.exists()):
        return MissionStore.open(path, mirror=mirror)
    cfg = args.config
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(PlannedPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned)
