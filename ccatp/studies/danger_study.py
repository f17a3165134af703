"""The study `danger`: false edges and overrun of the thesis's edge rule and of the daemon's.

A cell is a mirror (width of the gaps), a speed and a crossing: an angle to the seam's normal, or a quarter turn in
place whose sensors move at that speed. Both rules judge the same transits; each rule has its own drives to the rim,
which it stops. Set points are constant. Slip, sensors and panel edges are those of the world; creep and vibration are
left out.
"""

from collections.abc import Callable, Sequence
from math import cos, erf, hypot, pi, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, EventCode, FloatArray, PanelId, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.plant import Plant
from ccatp.sim.sensors import SensorSuite, named
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.results import Measure, draw_ranges, grouped, rows_by

SPEEDS_M_S = (0.05, 0.10, 0.15, 0.20)
TURN = "turn"
CROSSINGS: tuple[int | str, ...] = (0, 15, 30, 45, 60, TURN)
RULES = {"thesis": "off for 0.1 s (thesis)", "shipped": "travel against the map (ours)"}
OFF_S = 0.1
"""Threshold of the thesis's rule: the time in which a sensor crosses a gap of 1 cm at 0.1 m/s."""
# Errors of the estimate that the rules get, as of a good localizer in a disturbed world: sigmas, drawn once per drive.
POSITION_SIGMA_M, HEADING_SIGMA_RAD = 1.5e-3, 2e-3
_SHOWN = (
    "false_edges false_edge_probability false_edge_low false_edge_high "
    "overrun_mean_mm overrun_p95_mm overrun_max_mm falls"
)
_MARGIN_M = 0.01  # initial distance of the first sensor before a seam, final distance of the last one behind it
_APPROACH_M = 0.03  # initial distance of the first sensor before the rim
_BESIDE_M = 0.10  # largest distance from a panel's middle at which a drive meets the rim
_ASKEW_RAD = 0.05  # largest initial angle to an axis of a turn in place
_RUN_DOWN_S = 1.0  # a robot with zero set points has stopped after this time: a dozen time constants
_BLIND_M = 0.4  # a drive ends after this distance if no edge was detected
_DRIVES = 25  # of each kind in a job
_TRANSITS, _RIM = 3, 4  # streams of random numbers of a seed
_CONFIDENCE = erf(1.96 / sqrt(2.0))  # 95 %: within 1.96 standard deviations
_RESAMPLES = 2000


def drive_frame(seq: int, t_s: float, enc: list[WheelSample], edge: list[EdgeSample]) -> Sensors:
    """A sensors frame with only the fields that the rules read."""
    return Sensors(seq, t_s, [], enc, edge, None, (0.0, 0.0), 1.0, CommandEcho(0, 0.0, 0.0, False), [])


EdgeRule = Callable[[Sensors, EstimateMessage], bool]
"""Takes one frame after the other; returns whether there is an edge."""


def off_time_rule(off_s: float) -> EdgeRule:
    """The thesis's rule (3.4.1): an edge if a sensor is off for longer than ``off_s``, a gap's time at 0.1 m/s.

    The time restarts when the sensor is on again.
    """
    since_s: list[float | None] = [None] * 4

    def judge(frame: Sensors, estimate: EstimateMessage) -> bool:
        del estimate  # the rule has no map
        found = False
        for t_s, *values in frame.edge:
            for k, value in enumerate(values):
                begun_s = since_s[k]
                if value == 1:
                    since_s[k] = None
                elif begun_s is None:
                    since_s[k] = t_s
                else:
                    found = found or t_s - begun_s > off_s
        return found

    return judge


def build_rule(name: str, mirror: Mirror, cfg: Config) -> EdgeRule:
    """A rule of ``RULES``: the thesis's, or the daemon's, which compares the travel with the map."""
    if name == "thesis":
        return off_time_rule(OFF_S)
    monitor = DangerMonitor(mirror, cfg.robot, cfg.danger)
    return lambda frame, estimate: monitor.step(frame, estimate).code is EventCode.NEAR_EDGE


class Rig:
    """One simulated robot with its sensors and an estimate of its pose."""

    def __init__(self, mirror: Mirror, cfg: Config, start: DeckPose, rng: np.random.Generator) -> None:
        slip_rng, error_rng, sensors_rng = rng.spawn(3)
        world, robot, lag_s = cfg.world, cfg.robot, cfg.sim.robot.wheel_lag_s
        radius_m, base_m = robot.wheel_radius_m, robot.wheel_base_m
        plant = Plant(mirror.surface, start, wheel_radius_m=radius_m, wheel_base_m=base_m, wheel_lag_s=lag_s)
        self.plant = plant
        # Nothing steers here, so both wheels have the same slip: the angle at the edge matters, not the path to it.
        plant.right_scale = plant.left_scale = 1.0 - float(slip_rng.uniform(world.slip_min, world.slip_max))
        self._sensors = SensorSuite(cfg, mirror, sensors_rng, lag_s=lag_s)
        self._sensors.edges.place(plant)
        dx, dy, turn = error_rng.standard_normal(3).tolist()
        self._error = POSITION_SIGMA_M * dx, POSITION_SIGMA_M * dy, HEADING_SIGMA_RAD * turn
        self._frame_s = 1.0 / cfg.sim.robot.frame_hz
        self._seq = 0
        self._estimate = self._estimated()

    def frame(self, right_rad_s: float, left_rad_s: float) -> tuple[Sensors, EstimateMessage]:
        """Drive one frame with these set points; returns the frame and the latest estimate before it."""
        estimate, plant = self._estimate, self.plant
        t_s = self._seq * self._frame_s
        plant.step(t_s, self._frame_s, right_rad_s, left_rad_s)
        self._seq += 1
        edges, _, encoders, _ = self._sensors.read(self._seq, plant)
        edge, enc = named(EdgeSample, edges), named(WheelSample, encoders)
        if is_estimate_due(self._seq):
            self._estimate = self._estimated()
        return drive_frame(self._seq, self._seq * self._frame_s, enc, edge), estimate

    @property
    def places(self) -> list[tuple[float, float]]:
        """Positions of the edge sensors, deck frame, m."""
        return self._sensors.edges.places

    def _estimated(self) -> EstimateMessage:
        p, (dx, dy, turn) = self.plant, self._error
        return EstimateMessage(
            seq=self._seq, t_s=self._seq * self._frame_s, x_m=p.x_m + dx, y_m=p.y_m + dy,
            heading_rad=p.heading_rad + turn, sigma_m=POSITION_SIGMA_M, state="driving",
        )  # fmt: skip

    def at_speed(self, v_m_s: float, omega_rad_s: float, cfg: Config) -> tuple[float, float]:
        """Set points (right, left), rad/s, of a twist; the wheels start at these speeds."""
        r, half = cfg.robot.wheel_radius_m, 0.5 * cfg.robot.wheel_base_m
        set_points = (v_m_s + omega_rad_s * half) / r, (v_m_s - omega_rad_s * half) / r
        self.plant.right_rad_s, self.plant.left_rad_s = set_points
        return set_points


def transit(
    mirror: Mirror, cfg: Config, v_m_s: float, angle_rad: float | None, rng: np.random.Generator
) -> tuple[bool, ...]:
    """Cross a seam between two columns, or make a quarter turn beside it; whether each rule reports an edge.

    ``angle_rad``: between the path and the seam's normal; None: turn in place.
    """
    place_rng, rig_rng = rng.spawn(2)
    # Panels with neighbours all around their right seam: the rim is far from every path over it.
    around = ((0, 1), (1, 0), (1, 1), (-1, 0), (-1, 1))
    inner = [
        panel
        for panel in mirror.panels.values()
        if all(PanelId(panel.id.row + r, panel.id.col + c) in mirror.panels for r, c in around)
    ]
    panel = inner[int(place_rng.integers(len(inner)))]
    seam_m = panel.x_m + panel.half_x_m + 0.5 * mirror.gap_m
    ahead, left = cfg.robot.edge_sensors_m[0]
    if angle_rad is None:
        reach_m = hypot(ahead, left)
        start = DeckPose(
            seam_m + place_rng.uniform(-reach_m, reach_m),
            panel.y_m + place_rng.uniform(-1.0, 1.0) * (panel.half_y_m - reach_m - _MARGIN_M),
            0.5 * pi * int(place_rng.integers(4)) + place_rng.uniform(-_ASKEW_RAD, _ASKEW_RAD),
        )
        omega_rad_s = v_m_s / reach_m * int(place_rng.choice((-1, 1)))
        drive_s, v_m_s = 0.5 * pi / abs(omega_rad_s), 0.0
    else:
        reach_m, omega_rad_s = ahead * cos(angle_rad) + left * sin(angle_rad), 0.0
        half_way_m = (reach_m + _MARGIN_M + 0.5 * mirror.gap_m) / cos(angle_rad)
        heading_rad = angle_rad * int(place_rng.choice((-1, 1))) + pi * int(place_rng.integers(2))
        beside_m = max(panel.half_y_m - reach_m - half_way_m * sin(angle_rad), 0.0)
        middle_m = panel.y_m + place_rng.uniform(-beside_m, beside_m)
        start = DeckPose(seam_m - half_way_m * cos(heading_rad), middle_m - half_way_m * sin(heading_rad), heading_rad)
        drive_s = 2.0 * half_way_m / (v_m_s * (1.0 - cfg.world.slip_max))
    rig = Rig(mirror, cfg, start, rig_rng)
    set_points = rig.at_speed(v_m_s, omega_rad_s, cfg)
    rules = [build_rule(name, mirror, cfg) for name in RULES]
    found = [False] * len(rules)
    for _ in range(round(drive_s * cfg.sim.robot.frame_hz)):
        seen = rig.frame(*set_points)
        for k, rule in enumerate(rules):
            found[k] = rule(*seen) or found[k]
    return tuple(found)


def drive_to_rim(
    mirror: Mirror, cfg: Config, v_m_s: float, angle_rad: float, name: str, rng: np.random.Generator
) -> tuple[float, bool]:
    """Drive over the rim until a rule detects an edge; set points become zero one frame and the link's delays later.

    Returns the overrun of the furthest sensor beyond the rim, m, and whether the robot fell.
    """
    place_rng, rig_rng = rng.spawn(2)
    at_rim = [p for p in mirror.panels.values() if PanelId(p.id.row, p.id.col + 1) not in mirror.panels]
    panel = at_rim[int(place_rng.integers(len(at_rim)))]
    ahead, left = cfg.robot.edge_sensors_m[0]
    heading_rad = angle_rad * int(place_rng.choice((-1, 1)))
    before_m = ahead * cos(angle_rad) + left * sin(angle_rad) + _APPROACH_M
    meets_m = panel.y_m + place_rng.uniform(-_BESIDE_M, _BESIDE_M)
    start = DeckPose(
        panel.x_m + panel.half_x_m - before_m, meets_m - _APPROACH_M * float(np.tan(heading_rad)), heading_rad
    )
    rig = Rig(mirror, cfg, start, rig_rng)
    set_points = rig.at_speed(v_m_s, 0.0, cfg)
    rule, hz = build_rule(name, mirror, cfg), cfg.sim.robot.frame_hz
    frames_left = round(_BLIND_M / v_m_s * hz)
    late = round((cfg.world.sensors_delay_s + cfg.world.commands_delay_s) * hz)
    is_seen = has_fallen = False
    while frames_left > 0:
        if is_seen:
            late -= 1
        seen = rig.frame(*(set_points if not is_seen or late >= 0 else (0.0, 0.0)))
        frames_left -= 1
        if not is_seen and rule(*seen):
            is_seen, frames_left = True, round(_RUN_DOWN_S * hz)
        has_fallen = has_fallen or mirror.rim.signed_distance_m(rig.plant.x_m, rig.plant.y_m) < 0.0
    return max(-mirror.rim.signed_distance_m(x, y) for x, y in rig.places), has_fallen


def run_job(job: Job) -> JobOutcome:
    """``_DRIVES`` transits, and as many drives to the rim for each rule; no drives for a turn."""
    cfg, v_m_s, way, seed = job.cfg, float(job.factors["speed_m_s"]), job.factors["crossing"], job.cfg.run.seed
    mirror = build_mirror(cfg.mirror)
    angle_rad = None if way == TURN else radians(float(way))
    found = [
        transit(mirror, cfg, v_m_s, angle_rad, np.random.default_rng([seed, _TRANSITS, k])) for k in range(_DRIVES)
    ]
    values: dict[str, Any] = {"transits": len(found)}
    arrays: dict[str, FloatArray] = {}
    for name, false_edges in zip(RULES, np.sum(found, axis=0), strict=True):
        values[name] = {"false_edges": int(false_edges)}
        if angle_rad is not None:
            # Both rules get the same random numbers, so only the rule differs.
            drives = [
                drive_to_rim(mirror, cfg, v_m_s, angle_rad, name, np.random.default_rng([seed, _RIM, k]))
                for k in range(_DRIVES)
            ]
            values[name]["falls"] = sum(has_fallen for _, has_fallen in drives)
            arrays[f"{name}_overrun_m"] = np.array([overrun_m for overrun_m, _ in drives])
    return JobOutcome(values, arrays)


def combine(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Probability of a false edge per transit with its interval, and the distribution of the overrun."""
    transits = sum(outcome.values["transits"] for outcome in outcomes)
    values: dict[str, Any] = {"transits": transits}
    arrays: dict[str, FloatArray] = {}
    for name in RULES:
        false_edges = sum(outcome.values[name]["false_edges"] for outcome in outcomes)
        # Wilson 1927: valid for zero false edges, too
        interval = binomtest(false_edges, transits).proportion_ci(_CONFIDENCE, "wilson")
        values[name] = {
            "false_edges": false_edges,
            "false_edge_probability": false_edges / transits,
            "false_edge_low": float(interval.low),
            "false_edge_high": float(interval.high),
        }
        key = f"{name}_overrun_m"
        kept = [outcome.arrays[key] for outcome in outcomes if key in outcome.arrays]
        if kept:
            arrays[key] = overrun_m = np.concatenate(kept)
            low, high = bootstrap(overrun_m, 0.95)
            values[name] |= {
                "overrun_mean_mm": 1e3 * float(np.mean(overrun_m)),
                "overrun_p95_mm": 1e3 * float(np.quantile(overrun_m, 0.95)),
                "overrun_p95_low_mm": 1e3 * low,
                "overrun_p95_high_mm": 1e3 * high,
                "overrun_min_mm": 1e3 * float(np.min(overrun_m)),
                "overrun_median_mm": 1e3 * float(np.median(overrun_m)),
                "overrun_max_mm": 1e3 * float(np.max(overrun_m)),
                "drives": overrun_m.size,
                "falls": sum(outcome.values[name]["falls"] for outcome in outcomes),
            }
    return JobOutcome(values, arrays)


def bootstrap(values: FloatArray, q: float) -> tuple[float, float]:
    """95 % interval of the quantile ``q`` (0 to 1) of values (k,) by resampling with a fixed seed."""
    drawn = np.random.default_rng(0).choice(values, (_RESAMPLES, values.size))
    low, high = np.quantile(np.quantile(drawn, q, axis=1), (0.025, 0.975)).tolist()
    return low, high


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``danger_false_edges_<mirror>`` and ``danger_overrun_<mirror>``, one panel per rule."""
    false_edges, overruns = [], []
    for rule, name in RULES.items():
        ends = f"{rule}.false_edge_low", f"{rule}.false_edge_high"
        false_edges.append(Measure(name, ends, f"{rule}.false_edge_probability", is_log=False))
        ends = f"{rule}.overrun_min_mm", f"{rule}.overrun_max_mm"
        overruns.append(Measure(name, ends, f"{rule}.overrun_median_mm", line=0.0, is_log=False))
    for (mirror,), there in grouped(results, "mirror").items():
        title, names = f"A seam taken for an edge on {mirror}: probability, 95 %", ("speed_m_s", "crossing")
        draw_ranges(rows_by(there, *names), false_edges, title, out / f"danger_false_edges_{mirror}")
        straight = [cell for cell in there if cell.factors["crossing"] != TURN]
        title = f"Furthest sensor beyond the rim, mm, on {mirror}: least, median, largest"
        draw_ranges(rows_by(straight, *names), overruns, title, out / f"danger_overrun_{mirror}")


STUDY = Study(
    cells=lambda: [Cell({"speed_m_s": v_m_s, "crossing": way}) for v_m_s in SPEEDS_M_S for way in CROSSINGS],
    run_job=run_job,
    combine=combine,
    columns="transits\n" + "\n".join(f"{rule}: {_SHOWN}" for rule in RULES),
    draw=draw,
    defaults={"run.world": "hard"},
    mirrors=("fyst-m1", "thesis-m1"),
    runs=12,
)
