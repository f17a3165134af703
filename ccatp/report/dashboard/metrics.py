"""The state of a run as metrics of Prometheus."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from math import sqrt
from typing import Any, Protocol

from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

import ccatp

State = Mapping[str, Any]
Samples = Iterable[tuple[str, float | None]]
# Name, help, part of the state, value; left out while that part is not known.
GAUGES: tuple[tuple[str, str, str, Callable[[Any], float | None]], ...] = (
    ("elapsed_seconds", "Of the mission, by the robot's clock.", "mission", lambda m: m["elapsed_s"]),
    ("remaining_seconds", "Estimated time to the end of the mission.", "mission", lambda m: m["eta_s"]),
    ("frame_lag_seconds", "Lateness of the last late frame.", "mission", lambda m: 1e-3 * m["worst_lateness_ms"]),
    ("event_code", "Event code: 0 normal, 1 near the edge, 2 aborted.", "verdict", lambda v: v["code"]),
    ("severity", "Severity of the cause, 0 none to 6 fault.", "verdict", lambda v: v["severity"]),
    ("battery_charge_ratio", "Charge of the robot's battery, 0 to 1.", "robot", lambda r: r["charge"]),
    ("wheels_held", "1 when the robot holds its wheels by its own rules.", "robot", lambda r: r["is_held"]),
    ("drive_age_seconds", "Age of the drive in force, by the robot.", "robot", lambda r: r["drive_age_s"]),
    ("permit_age_seconds", "Age of the permit in force, by the robot.", "robot", lambda r: r["permit_age_s"]),
    ("robot_faults", "Faults that the robot reports.", "robot", lambda r: len(r["faults"])),
    ("position_sigma_meters", "Root of the summed variances of x and y.", "pose", lambda p: _sigma_m(*p.covariance_m2)),
)  # fmt: skip
POINT_COUNTS = {"planned": "total", "measured": "done", "skipped": "skipped"}


class StateSource(Protocol):
    """The part of ``StateBroadcaster`` that is measured."""

    @property
    def pages(self) -> int:
        """Open pages."""

    def state(self) -> State:
        """``RunStateView.status_data`` now."""


class StateCollector(Collector):
    """Collects the metrics of a run at each request; ``ground`` is that of the page."""

    def __init__(self, hub: StateSource, ground: Mapping[str, Any]) -> None:
        self._hub, self._ground = hub, ground

    def collect(self) -> Iterator[Metric]:
        """All metrics that have a value."""
        return (metric for metric in self._all(self._hub.state()) if metric.samples)

    def _all(self, state: State) -> Iterator[Metric]:
        info = GaugeMetricFamily("ccatp_info", "What runs.", labels=("mirror", "simulation", "version"))
        info.add_metric((str(self._ground["title"]), str(state["is_sim"]).lower(), ccatp.__version__), 1.0)
        yield info
        up = not state["trouble"]
        yield _gauge("up", "1 when both loops report and the robot sends frames.", [("", up)])
        yield _gauge("dashboard_pages", "Open pages.", [("", self._hub.pages)])
        links = state["links"]
        yield _gauge("link_up", "1 when that end reports.", [(link.name, link.is_well) for link in links], "link")
        ages = [(link.name, link.age_s) for link in links]
        yield _gauge("link_age_seconds", "Since the last message of that end.", ages, "link")
        restarts = CounterMetricFamily(
            "ccatp_process_restarts", "Restarts of a process that the dashboard has seen.", labels=("process",)
        )
        for process, count in state["restarts"].items():
            restarts.add_metric((process,), count)
        yield restarts
        for name, text, part, value_of in GAUGES:
            if state[part] is not None:
                yield _gauge(name, text, [("", value_of(state[part]))])
        if (mission := state["mission"]) is not None:
            states = [(known, known == mission["state"]) for known in self._ground["states"]]
            yield _gauge("mission_state", "1 for the state of the mission.", states, "state")
            counts = [(name, mission[key]) for name, key in POINT_COUNTS.items()]
            yield _gauge("points", "Measurement points, or waypoints.", counts, "state")
            yield CounterMetricFamily(
                "ccatp_late_frames", "Frames that were served late.", value=mission["missed_deadlines"]
            )
        if (robot := state["robot"]) is not None:
            fans = zip(("left", "right"), robot["fans"], strict=True)
            yield _gauge("fan_duty_ratio", "Duty of the fans, as the robot echoes it, 0 to 1.", fans, "side")


def _gauge(name: str, text: str, samples: Samples, label: str = "") -> Metric:
    gauge = GaugeMetricFamily(f"ccatp_{name}", text, labels=(label,) if label else ())
    for value_of_label, value in samples:
        if value is not None:
            gauge.add_metric((value_of_label,) if label else (), float(value))
    return gauge


def _sigma_m(xx: float, _xy: float, yy: float) -> float:
    return sqrt(max(xx + yy, 0.0))
