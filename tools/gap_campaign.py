"""``python -m tools.gap_campaign``: the consistency of the estimate in gaps of the samples, as a table.

A cell has a drive (world, motors, filter), a way into the gap, a set of silent sensors, and a length of the gap. It is
overconfident if the mean NEES over the seeds is above the 99 % band and also above that of the same cell without a gap
by more than the band allows; inflated if the standard deviation is more than twice the rms error and more than in the
cell without a gap.
"""

import argparse
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from ccatp.core import FloatArray
from tools.gap_rig import FILTERS, GAPS_S, MOTORS, SILENT, WAYS, WORLDS, Drive, Errors, Way, run

# An ideal servo and an ideal floor: less than this is the resolution of the model (0.6 ms of dead time, 0.5 % of lag).
FLOOR_M, FLOOR_RAD = 1.5e-4, 1.5e-3


class Figures(NamedTuple):
    """Of one quantity: mean and 99th percentile of the NEES, rms error and rms of the standard deviation."""

    freedom: int
    mean: float
    p99: float
    rms: float
    sigma: float

    def band(self, seeds: int) -> tuple[float, float]:
        """99 % band of the mean over seeds."""
        low, high = (float(chi2.ppf(share, self.freedom * seeds)) / seeds for share in (0.005, 0.995))
        return low, high


class Cell(NamedTuple):
    """A cell with its figures, and those of the same cell without a gap."""

    drive: Drive
    way: Way
    silent: str
    gap_s: float
    seeds: int
    position: Figures
    heading: Figures
    without: tuple[Figures, Figures]

    @property
    def excess(self) -> float:
        """Largest mean NEES over what is allowed."""
        pairs = zip((self.position, self.heading), self.without, strict=True)
        return max(now.mean / self._most(now, without) for now, without in pairs)

    def _most(self, now: Figures, without: Figures) -> float:
        high = now.band(self.seeds)[1]
        # The mean of the cell without a gap is itself that of as many seeds.
        return max(high, without.mean * high / now.freedom)

    @property
    def is_overconfident(self) -> bool:
        """The errors are larger than the covariance says."""
        return self.excess > 1.0

    @property
    def is_inflated(self) -> bool:
        """The covariance is larger than the errors."""
        return self._is_above(lambda now: now.rms)

    @property
    def is_surely_inflated(self) -> bool:
        """It is, whatever rms error within the 99 % band the few seeds stand for."""
        return self._is_above(lambda now: now.rms * float(np.sqrt(now.freedom / now.band(self.seeds)[0])))

    def _is_above(self, rms: Callable[[Figures], float]) -> bool:
        pairs = zip((self.position, self.heading), self.without, (FLOOR_M, FLOOR_RAD), strict=True)
        return any(
            now.sigma > max(2.0 * rms(now), 1.3 * without.sigma / without.rms * rms(now), floor)
            for now, without, floor in pairs
        )

    @property
    def rms_mm(self) -> float:
        """Rms error of the position."""
        return 1e3 * self.position.rms

    @property
    def text(self) -> str:
        """One line."""
        position, heading = self.position, self.heading
        flags = "overconfident " * self.is_overconfident + "inflated" * self.is_inflated
        return (
            f"{'-'.join((*self.drive, *self.way)):34} {self.silent or 'none':13} {self.gap_s:5.2f} s  position NEES "
            f"{position.mean:6.2f} p99 {position.p99:6.1f} rms {1e3 * position.rms:7.3f} mm sigma/rms "
            f"{position.sigma / position.rms:5.2f}  heading NEES {heading.mean:5.2f} p99 {heading.p99:5.1f} rms "
            f"{1e3 * heading.rms:6.2f} mrad sigma/rms {heading.sigma / heading.rms:5.2f}  {flags}"
        ).rstrip()


def figures(errors: Sequence[Errors], k: int) -> tuple[Figures, Figures]:
    """Figures of position and heading at the end of gap ``k``."""
    off = np.array([e.position_m[k] for e in errors])
    P = np.array([e.covariance_m2[k] for e in errors])
    turned, sigma = (np.array([getattr(e, name)[k] for e in errors]) for name in ("heading_rad", "heading_sigma_rad"))
    squares: FloatArray = np.einsum("si,sij,sj->s", off, np.linalg.inv(P), off)
    trace = np.trace(P, axis1=1, axis2=2)
    return (
        _figures(2, squares, (off**2).sum(axis=1), trace),
        _figures(1, (turned / sigma) ** 2, turned**2, sigma**2),
    )


def _figures(freedom: int, squares: FloatArray, errors2: FloatArray, variances: FloatArray) -> Figures:
    p99, rms, sigma = np.quantile(squares, 0.99), np.sqrt(errors2.mean()), np.sqrt(variances.mean())
    return Figures(freedom, float(squares.mean()), float(p99), float(rms), float(sigma))


def cells_of(drive: Drive, drives: Sequence[dict[Way, dict[str, Errors]]]) -> list[Cell]:
    """All cells of a drive from its seeds; each includes the silent set ''."""
    found = []
    for way, sets in drives[0].items():
        for silent in sets:
            for k, gap_s in enumerate(GAPS_S):
                position, heading = figures([one[way][silent] for one in drives], k)
                without = figures([one[way][""] for one in drives], k)
                found.append(Cell(drive, way, silent, gap_s, len(drives), position, heading, without))
    return found


def table(cells: Sequence[Cell]) -> str:
    """All cells, one a line, after the bands."""
    position, heading = (figures.band(cells[0].seeds) for figures in (cells[0].position, cells[0].heading))
    head = f"{cells[0].seeds} seeds; 99 % bands of the mean NEES: position {position[0]:.2f} to {position[1]:.2f}, "
    head += f"heading {heading[0]:.2f} to {heading[1]:.2f}"
    return "\n".join((head, *(cell.text for cell in cells), ""))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--world", choices=WORLDS, action="append")
    parser.add_argument("--motors", choices=MOTORS, action="append")
    parser.add_argument("--filter", choices=FILTERS, action="append")
    args = parser.parse_args()
    for world in args.world or WORLDS:
        for motors in args.motors or MOTORS:
            for name in args.filter or FILTERS[:1]:
                drive = Drive(world, motors, name)
                drives = [run(drive, seed, WAYS, SILENT) for seed in range(args.seeds)]
                print(table(cells_of(drive, drives)), flush=True)


if __name__ == "__main__":
    main()
