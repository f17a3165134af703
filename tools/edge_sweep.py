"""Drives over the rim, turns beside it and stops over seams, all round a mirror, on the simulated plant.

The real danger rules judge frame by frame, with the estimate and the delays of a disturbed world. A case is a number:
the same number is the same drive. `make sweep` runs all of them, five to nine hours of one core, and `make test-slow`
a tenth, chosen at random: a block is a line of `blocks.jsonl`. A stopped sweep goes on there; what another build swept
does not count.
"""

import argparse
import hashlib
import json
import random
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from math import acos, atan2, ceil, cos, hypot, inf, pi, radians, sin
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ccatp
from ccatp.config.models import Config
from ccatp.core import DeckPose, EventCode, PanelId, Verdict
from ccatp.danger import DangerMonitor
from ccatp.mirror.mirror import Mirror
from ccatp.safety.edge_episode import EdgeLimits
from ccatp.studies.danger_study import Rig
from tests.support.scenario import config_of, mirror_of

MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
SPACING_M = 0.01
HEADINGS = range(0, 360, 5)
SPEEDS_M_S = (0.005, 0.02, 0.05, 0.1, 0.15)
TURNS_RAD_S = (-1.0, -0.2, 0.2, 1.0)
Error = tuple[float, float, float]
BLIND: Error = (inf, inf, inf)
OVERRUN_M = 0.020  # invariant I5
SLOWEST_COSINE = cos(radians(85.5))  # a way that is closer to the rim's direction than this does not lead over it
RUN_UP_M = 0.004  # of the first sensor to the rim: the rules have a track before it goes off
REACH_M = 1.2  # how far back a start is looked for: at 85 degrees to the normal all sensors are on from there
REST_M = 1e-4  # what a robot still rolls when it counts as standing
TURN_CLEARANCE_M = (0.100, 0.115, 0.125)  # of the centre: all four sensors on at some heading, a corner off at others


class Place(NamedTuple):
    """A point of the rim and the direction of the outward normal there."""

    x_m: float
    y_m: float
    normal_rad: float


@dataclass(slots=True)
class Tally:
    """What became of the drives: numbers of them, and the worst of each length and time."""

    drives: int = 0
    impossible: int = 0  # the robot cannot stand anywhere on the way
    falls: int = 0
    unseen: int = 0  # went over the rim, and no edge was declared
    after_m: float = 0.0  # furthest way of a sensor after the declaration
    beyond_m: float = 0.0  # furthest sensor beyond the rim
    late_s: float = 0.0  # longest from the first sensor beyond the rim to the withheld permit
    centre_m: float = -10.0  # furthest centre beyond the rim
    transits: int = 0
    over_gap: int = 0  # stops with a sensor over the gap
    false_edges: int = 0
    worst: list[str] = field(default_factory=list)

    def add(self, other: "Tally") -> None:
        for name, value in asdict(other).items():
            is_worst_of_all = name.endswith(("_m", "_s"))
            setattr(self, name, max(getattr(self, name), value) if is_worst_of_all else getattr(self, name) + value)

    @property
    def line(self) -> str:
        return (
            f"{self.drives} drives ({self.impossible} without a place to stand), {self.falls} falls, {self.unseen} "
            f"unseen, {1e3 * self.after_m:.1f} mm after the declaration, {1e3 * self.beyond_m:.1f} mm beyond the rim, "
            f"{1e3 * self.late_s:.0f} ms to the permit; {self.transits} transits, {self.over_gap} stops over a gap, "
            f"{self.false_edges} false edges"
        )


@lru_cache
def world(name: str) -> tuple[Config, Mirror]:
    return config_of(name, run__world="hard"), mirror_of(name)


@lru_cache
def places(name: str) -> tuple[Place, ...]:
    """The rim of a mirror, centimetre by centimetre."""
    vertices = world(name)[1].rim.vertices.tolist()
    found = []
    for a, b in zip(vertices, vertices[1:] + vertices[:1], strict=True):
        length = hypot(b[0] - a[0], b[1] - a[1])
        if length == 0.0:
            continue
        ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
        count = ceil(length / SPACING_M)
        # The outline runs counter-clockwise: outward is to the right.
        found += [
            Place(a[0] + (k + 0.5) / count * length * ux, a[1] + (k + 0.5) / count * length * uy, atan2(-ux, uy))
            for k in range(count)
        ]
    return tuple(found)


@lru_cache(maxsize=1)  # all speeds begin at the same place
def start_before(name: str, place: Place, heading_rad: float, sign: float) -> DeckPose | None:
    """Where a robot that drives at the place last stands with all its sensors on the mirror; None for nowhere."""
    cfg, mirror = world(name)
    sensors = np.array(cfg.robot.edge_sensors_m)
    c, s = cos(heading_rad), sin(heading_rad)
    ox, oy = sensors[:, 0] * c - sensors[:, 1] * s, sensors[:, 0] * s + sensors[:, 1] * c
    back = np.arange(0.0, REACH_M, 0.002)[:, None]
    xs, ys = place.x_m - sign * back * c, place.y_m - sign * back * s
    inside = mirror.rim.signed_distances_m(xs + ox, ys + oy).min(axis=1) > RUN_UP_M * abs(cos(heading_rad))
    inside &= mirror.rim.signed_distances_m(xs[:, 0], ys[:, 0]) > 0.05
    if not inside.any():
        return None
    k = int(np.argmax(inside))
    return DeckPose(float(xs[k, 0]), float(ys[k, 0]), heading_rad)


class Drive:
    """A robot that does what it is told until the danger rules forbid it.

    Args:
        error: of the estimate, x and y (m) and heading (rad), in place of one that is drawn; ``BLIND``: there is none.
    """

    def __init__(self, name: str, start: DeckPose, rng: np.random.Generator, error: Error | None = None) -> None:
        self.cfg, self.mirror = world(name)
        self.rig = Rig(self.mirror, self.cfg, start, rng)
        self._is_blind = error is BLIND
        if error is not None:
            self.rig._error = error
            self.rig._estimate = self.rig._estimated()
        self.monitor = DangerMonitor(self.mirror, self.cfg.robot, self.cfg.danger)
        self.hz = self.cfg.sim.robot.frame_hz
        self.delay = round((self.cfg.world.sensors_delay_s + self.cfg.world.commands_delay_s) * self.hz)
        self.has_edge = False

    def frame(self, right: float, left: float) -> Verdict:
        frame, estimate = self.rig.frame(right, left)
        verdict = self.monitor.step(frame, None if self._is_blind else estimate)
        self.has_edge |= verdict.code is EventCode.NEAR_EDGE
        return verdict

    def has_gone_m(self, start: DeckPose) -> float:
        return hypot(self.rig.plant.x_m - start.x_m, self.rig.plant.y_m - start.y_m)

    def beyond_m(self) -> list[float]:
        return [-self.mirror.rim.signed_distance_m(x, y) for x, y in self.rig.places]

    @property
    def rolls_m(self) -> float:
        """What the wheels still travel without a set point."""
        rate_rad_s = max(abs(self.rig.plant.right_rad_s), abs(self.rig.plant.left_rad_s))
        return self.cfg.robot.wheel_radius_m * self.cfg.sim.robot.wheel_lag_s * rate_rad_s


def run_off(
    name: str, start: DeckPose, v_m_s: float, omega_rad_s: float, rng: np.random.Generator, error: Error | None = None
) -> Tally:
    """Drive, or turn, until an edge is declared and the robot stands; without an estimate only edges count."""
    drive = Drive(name, start, rng, error)
    rig, hz = drive.rig, drive.hz
    set_points = rig.at_speed(v_m_s, omega_rad_s, drive.cfg)
    speed = max(abs(v_m_s), abs(omega_rad_s) * hypot(*drive.cfg.robot.edge_sensors_m[0]))
    frames = ceil((REACH_M + 0.05 if v_m_s else 2.0 * pi * 0.13) / speed * hz)
    late = drive.delay
    off_frame = declared_frame = -1
    at_declaration = [0.0] * 4
    after_m = most_m = 0.0
    centre_m = -10.0
    for k in range(frames + 300):
        if declared_frame >= 0:
            late -= 1
        is_driven = declared_frame < 0 or late >= 0
        verdict = drive.frame(*(set_points if is_driven else (0.0, 0.0)))
        is_off = not all(rig._sensors.edges._values)
        beyond = drive.beyond_m() if is_off or drive.has_edge or declared_frame >= 0 else [0.0] * 4
        if off_frame < 0 and is_off and max(beyond) > 0.0:
            off_frame = k
        if declared_frame < 0 and _is_barred(verdict, v_m_s, error is BLIND):
            declared_frame, at_declaration = k, [max(b, 0.0) for b in beyond]
        if declared_frame >= 0:
            after_m = max(after_m, *(now - then for now, then in zip(beyond, at_declaration, strict=True)))
        most_m = max(most_m, *beyond)
        centre_m = max(centre_m, -drive.mirror.rim.signed_distance_m(rig.plant.x_m, rig.plant.y_m))
        if centre_m > 0.0 or (not is_driven and drive.rolls_m < REST_M) or (declared_frame < 0 and k >= frames):
            break
    is_unseen = declared_frame < 0 and most_m > 0.0
    late_s = max(declared_frame - off_frame, 0) / hz if declared_frame >= 0 and off_frame >= 0 else 0.0
    return Tally(1, 0, int(centre_m > 0.0), int(is_unseen), after_m, most_m, late_s, centre_m)


def _is_barred(verdict: Verdict, v_m_s: float, only_edges: bool) -> bool:
    """Whether the motion is over: an edge, or its direction is not permitted any more."""
    is_permitted = only_edges or (verdict.forward if v_m_s > 0.0 else verdict.reverse)
    return verdict.code is EventCode.NEAR_EDGE or not is_permitted


def rim_case(number: int) -> tuple[str, Callable[[], Tally]]:
    """The drive of a number: mirror, place, heading, speed."""
    k, speed = divmod(number, len(SPEEDS_M_S))
    k, heading = divmod(k, len(HEADINGS))
    name, place = _place(k)
    v_m_s, heading_rad = SPEEDS_M_S[speed], radians(HEADINGS[heading])
    text = f"rim {number}: {name} at ({place.x_m:.3f}, {place.y_m:.3f}) heading {HEADINGS[heading]} {v_m_s} m/s"

    def run() -> Tally:
        cosine = cos(heading_rad - place.normal_rad)
        sign = 1.0 if cosine > 0.0 else -1.0
        start = start_before(name, place, heading_rad, sign) if abs(cosine) > SLOWEST_COSINE else None
        if start is None:
            return Tally(impossible=1)
        return run_off(name, start, sign * v_m_s, 0.0, np.random.default_rng([number, 1]))

    return text, run


def speed_of(number: int) -> float:
    """Speed of a drive over the rim, m/s."""
    return SPEEDS_M_S[number % len(SPEEDS_M_S)]


def turn_case(number: int) -> tuple[str, Callable[[], Tally]]:
    """A turn in place beside the rim."""
    k, turn = divmod(number, len(TURNS_RAD_S))
    k, depth = divmod(k, len(TURN_CLEARANCE_M))
    name, place = _place(k)
    rng = np.random.default_rng([number, 2])
    heading_rad, inside_m = float(rng.uniform(-pi, pi)), TURN_CLEARANCE_M[depth]
    text = f"turn {number}: {name} at ({place.x_m:.3f}, {place.y_m:.3f}) {inside_m} m inside {TURNS_RAD_S[turn]} rad/s"

    def run() -> Tally:
        x, y = place.x_m - inside_m * cos(place.normal_rad), place.y_m - inside_m * sin(place.normal_rad)
        drive_start = DeckPose(x, y, heading_rad)
        cfg, mirror = world(name)
        c, s = cos(heading_rad), sin(heading_rad)
        sensors = [(x + a * c - b * s, y + a * s + b * c) for a, b in cfg.robot.edge_sensors_m]
        if min(mirror.rim.signed_distance_m(*p) for p in sensors) < RUN_UP_M:
            return Tally(impossible=1)
        return run_off(name, drive_start, 0.0, TURNS_RAD_S[turn], rng)

    return text, run


@lru_cache
def _ends() -> tuple[int, ...]:
    return tuple(np.cumsum([len(places(name)) for name in MIRRORS]).tolist())


def _place(k: int) -> tuple[str, Place]:
    ends = _ends()
    which = int(np.searchsorted(ends, k, side="right"))
    return MIRRORS[which], places(MIRRORS[which])[k - (ends[which - 1] if which else 0)]


def rim_cases() -> int:
    """How many drives over the rim there are."""
    return _ends()[-1] * len(HEADINGS) * len(SPEEDS_M_S)


def turn_cases() -> int:
    """How many turns beside it."""
    return _ends()[-1] * len(TURN_CLEARANCE_M) * len(TURNS_RAD_S)


# -- seams ------------------------------------------------------------------------------------------------------------


def steepest_rad(name: str) -> float:
    """At what angle to its normal a seam may be crossed, by the rules: 60 deg, and more where it is narrow."""
    cfg, mirror = world(name)
    return acos(EdgeLimits(mirror.gap_m, cfg.danger).min_cosine)


def seam_case(number: int) -> tuple[str, Callable[[], Tally]]:
    """A way over a seam, or a stop over it: mirror, seam, angle, speed and length of the stop drawn by number."""
    rng = np.random.default_rng([number, 3])
    name = MIRRORS[number % len(MIRRORS)]
    is_stop = bool(number // len(MIRRORS) % 2)
    v_m_s = float(rng.choice(SPEEDS_M_S) if is_stop else rng.uniform(SPEEDS_M_S[0], SPEEDS_M_S[-1]))
    angle_rad = float(rng.uniform(-1.0, 1.0)) * steepest_rad(name)
    stop_s = float(60.0 ** rng.uniform(-1.0, 1.0)) if is_stop else 0.0
    text = f"seam {number}: {name} {v_m_s:.3f} m/s at {angle_rad:.3f} rad, stop {stop_s:.2f} s"
    return text, lambda: cross(name, v_m_s, angle_rad, stop_s, rng)


def cross(name: str, v_m_s: float, angle_rad: float, stop_s: float, rng: np.random.Generator) -> Tally:
    """Carry the leading sensors over a seam, and stop with one of them over the gap where that is asked for."""
    _, mirror = world(name)
    start, course_sign = _start_at_seam(name, angle_rad, v_m_s, rng)
    drive = Drive(name, start, rng)
    set_points = drive.rig.at_speed(course_sign * v_m_s, 0.0, drive.cfg)
    lag_m = v_m_s * drive.cfg.sim.robot.wheel_lag_s
    way_m = 0.02 + (lag_m + 0.5 * mirror.gap_m / cos(angle_rad)) + 0.01 / cos(angle_rad)
    stop_at_m = 0.02 + 0.5 * mirror.gap_m / cos(angle_rad)
    tally = Tally(transits=1)
    has_stopped = stop_s == 0.0
    for _ in range(ceil((way_m + mirror.gap_m / cos(angle_rad) + 0.05) / v_m_s * 1.06 * drive.hz)):
        drive.frame(*set_points)
        if not has_stopped and drive.has_gone_m(start) >= stop_at_m:
            has_stopped = True
            for _ in range(ceil((stop_s + 0.3) * drive.hz)):
                drive.frame(0.0, 0.0)
            tally.over_gap = int(not all(drive.rig._sensors.edges._values))
    tally.false_edges = int(drive.has_edge)
    return tally


def _start_at_seam(name: str, angle_rad: float, v_m_s: float, rng: np.random.Generator) -> tuple[DeckPose, float]:
    """A pose whose first sensor comes to the middle of a seam's gap after 20 mm, the way of running down left out."""
    cfg, mirror = world(name)
    around = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]
    inner = [
        p
        for p in mirror.panels.values()
        if all(PanelId(p.id.row + r, p.id.col + c) in mirror.panels for r, c in around)
    ]
    panel = inner[int(rng.integers(len(inner)))]
    is_x, side, sign = bool(rng.integers(2)), int(rng.choice((-1, 1))), float(rng.choice((-1.0, 1.0)))
    course = (0.0 if side > 0 else pi) if is_x else side * pi / 2
    course += angle_rad
    heading = course if sign > 0.0 else course + pi
    lead = max(
        (a * cos(heading) - b * sin(heading)) * (cos(course - angle_rad))
        + (a * sin(heading) + b * cos(heading)) * sin(course - angle_rad)
        for a, b in cfg.robot.edge_sensors_m
    )
    half, across = (panel.half_x_m, panel.half_y_m) if is_x else (panel.half_y_m, panel.half_x_m)
    along = float(rng.uniform(-1.0, 1.0)) * (across - 0.2)
    before = lead + (0.02 + v_m_s * cfg.sim.robot.wheel_lag_s) * cos(angle_rad)
    to_seam = side * (half + 0.5 * mirror.gap_m - before)
    x, y = (to_seam, along) if is_x else (along, to_seam)
    return DeckPose(panel.x_m + x, panel.y_m + y, heading), sign


# -- running ----------------------------------------------------------------------------------------------------------


Case = Callable[[int], tuple[str, Callable[[], Tally]]]


def sweep(case: Case, numbers: Iterable[int]) -> Tally:
    """Run cases by number; the names of those that went wrong are kept."""
    tally = Tally()
    for number in numbers:
        text, run = case(number)
        one = run()
        tally.add(one)
        if not is_good(one):
            tally.worst.append(f"{text}: {one.line}")
    return tally


# -- the whole sweep ---------------------------------------------------------------------------------------------------

BLOCK = 4000  # drives: some seconds
SEAMS = 300_000  # no false edge in as many says one in 100,000 at most, with 95 %
KINDS: dict[str, tuple[Case, Callable[[], int]]] = {
    "rim": (rim_case, rim_cases),
    "turn": (turn_case, turn_cases),
    "seam": (seam_case, lambda: SEAMS),
}
Block = tuple[str, int]


def build_id() -> str:
    """What sweeps: a change of any file of the package, or of the drives, is another build."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    root = Path(ccatp.__file__).parent
    for path in sorted(path for path in root.rglob("*") if path.suffix in {".py", ".so", ".toml"}):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def blocks() -> list[Block]:
    """All of them, mixed: what has been swept at any time is a sample of the whole."""
    found = [(kind, first) for kind, (_, count) in KINDS.items() for first in range(0, count(), BLOCK)]
    random.Random(9).shuffle(found)
    return found


def run_block(block: Block) -> tuple[Block, Tally]:
    """The drives of a block."""
    kind, first = block
    case, count = KINDS[kind]
    return block, sweep(case, range(first, min(first + BLOCK, count())))


def run_all(todo: list[Block], workers: int) -> Iterator[tuple[Block, Tally]]:
    """Blocks as they are done; one worker is this process."""
    with get_context("spawn").Pool(workers) if workers > 1 else nullcontext() as pool:
        yield from map(run_block, todo) if pool is None else pool.imap_unordered(run_block, todo)


def is_good(tally: Tally) -> bool:
    """Nobody fell, no edge was missed, none was false, and all stood in time."""
    return not (tally.falls or tally.unseen or tally.false_edges) and tally.after_m <= OVERRUN_M


def read_blocks(path: Path, its_build: str) -> dict[Block, Tally]:
    """What this build swept before; a line that was cut off is swept again."""
    done: dict[Block, Tally] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if row["build"] == its_build:
            done[row["kind"], row["first"]] = Tally(**row["tally"])
    return done


def total(tallies: Iterable[Tally]) -> Tally:
    """Of several blocks."""
    of_all = Tally()
    for tally in tallies:
        of_all.add(tally)
    return of_all


def main(arguments: list[str]) -> int:
    """0 if what has been swept is good, 1 if not."""
    parser = argparse.ArgumentParser(prog="edge_sweep", description=__doc__)
    parser.add_argument("dir", type=Path, metavar="DIR", help="where blocks.jsonl lies or shall lie")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--blocks", type=int, metavar="N", help="stop after so many")
    parser.add_argument("--share", type=float, default=1.0, metavar="F", help="a random part of all blocks")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of that part")
    args = parser.parse_args(arguments)
    args.dir.mkdir(parents=True, exist_ok=True)
    path, its_build = args.dir / "blocks.jsonl", build_id()
    every, done = blocks(), read_blocks(path, its_build)
    every = random.Random(args.seed).sample(every, ceil(args.share * len(every)))
    todo = [block for block in every if block not in done][: args.blocks]
    print(f"{len(done)} of {len(every)} blocks are done, {len(todo)} to do", flush=True)
    with path.open("a") as file:
        file.write("\n")  # the line before may have been cut off
        for block, tally in run_all(todo, args.workers):
            done[block] = tally
            row = {"build": its_build, "kind": block[0], "first": block[1], "tally": asdict(tally)}
            file.write(json.dumps(row) + "\n")
            file.flush()
            if not is_good(tally):
                print(*tally.worst, sep="\n", flush=True)
    for kind in KINDS:
        of_kind = [tally for block, tally in done.items() if block[0] == kind]
        print(f"{kind}: {len(of_kind)} of {sum(block[0] == kind for block in every)} blocks, {total(of_kind).line}")
    return 0 if is_good(total(done.values())) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
