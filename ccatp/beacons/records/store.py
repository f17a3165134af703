"""The database of a mission among beacons: reached waypoints and events. Survives ``kill -9``.

SQLite with a rollback journal and ``synchronous=FULL``: committed rows are on the disk, and the one file is complete.
"""

import sqlite3
from pathlib import Path

from ccatp.beacons.mission import WaypointArrival
from ccatp.errors import CcatpError, ExitStatus

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE waypoint (
    number INTEGER PRIMARY KEY, lap INTEGER NOT NULL, waypoint INTEGER NOT NULL, x_m REAL NOT NULL, y_m REAL NOT NULL,
    reached_s REAL, estimate_x_m REAL, estimate_y_m REAL, xx_m2 REAL, xy_m2 REAL, yy_m2 REAL
);
CREATE TABLE event (t_s REAL NOT NULL, level TEXT NOT NULL, text TEXT NOT NULL);
"""


class BeaconStoreError(CcatpError):
    """The database cannot be created."""

    exit_status = ExitStatus.USAGE


class BeaconStore:
    """The database of one run.

    ``laps``: over the waypoints; 0 for a mission without waypoints. Raises BeaconStoreError: the file exists, or cannot
    be created.
    """

    def __init__(self, path: Path, meta: dict[str, str], waypoints: tuple[tuple[float, float], ...], laps: int) -> None:
        if path.exists():
            raise BeaconStoreError(f"{path}: holds a mission already; give another --run-dir")
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(f"BEGIN; {_SCHEMA} COMMIT;")
        except sqlite3.Error as error:
            raise BeaconStoreError(f"{path}: cannot be made: {error}") from error
        planned = [
            (lap * len(waypoints) + at, lap, at, *place) for lap in range(laps) for at, place in enumerate(waypoints)
        ]
        with self._db:
            self._db.execute("BEGIN")
            self._db.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
            self._db.executemany(
                "INSERT INTO waypoint (number, lap, waypoint, x_m, y_m) VALUES (?, ?, ?, ?, ?)", planned
            )

    def record_arrival(self, t_s: float, number: int, arrival: WaypointArrival) -> None:
        """Record a reached waypoint; ``t_s``: robot time; ``number``: counted over all laps."""
        self._db.execute(
            "UPDATE waypoint SET reached_s = ?, estimate_x_m = ?, estimate_y_m = ?, xx_m2 = ?, xy_m2 = ?, yy_m2 = ? "
            "WHERE number = ?",
            (t_s, *arrival.belief.ellipse, number),
        )

    def record_event(self, t_s: float, level: str, text: str) -> None:
        """Record an event; ``t_s``: robot time."""
        self._db.execute("INSERT INTO event VALUES (?, ?, ?)", (t_s, level, text))

    def close(self) -> None:
        """Close the file."""
        self._db.close()
