"""The state of a run in the text format that Prometheus reads (exposition format 0.0.4)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import ccatp

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
Labels = tuple[tuple[str, str], ...]
Sample = tuple[Labels, float]
_ESCAPES = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})


class _Page:
    """Metrics, one after the other; one without a sample is left out."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def put(self, name: str, kind: str, help_text: str, samples: Iterable[Sample]) -> None:
        rows = [f"ccatp_{name}{_labels(labels)} {_number(value)}" for labels, value in samples]
        if rows:
            self.lines += [f"# HELP ccatp_{name} {help_text}", f"# TYPE ccatp_{name} {kind}", *rows]

    def gauge(self, name: str, help_text: str, value: float | None) -> None:
        self.put(name, "gauge", help_text, [] if value is None else [((), value)])


def metrics_text(state: Mapping[str, Any], ground: Mapping[str, Any], pages: int) -> str:
    """The metrics.

    Args:
        state: ``View.status_data``.
        ground: of the page: its title, and the states that the mission may have.
    """
    page = _Page()
    info = (
        ("mirror", str(ground["title"])),
        ("simulation", str(state["is_sim"]).lower()),
        ("version", ccatp.__version__),
    )
    page.put("info", "gauge", "What runs.", [(info, 1.0)])
    page.gauge("up", "1 when the run is well: both loops speak, and the robot sends frames.", not state["trouble"])
    _put_links(page, state)
    if (mission := state["mission"]) is not None:
        _put_mission(page, mission, ground["states"])
    if (verdict := state["verdict"]) is not None:
        page.gauge("event_code", "Event code: 0 normal, 1 near the edge, 2 aborted.", verdict["code"])
        page.gauge("severity", "Severity of what gave cause, 0 none to 6 fault.", verdict["severity"])
    if (robot := state["robot"]) is not None:
        _put_robot(page, robot)
    if (pose := state["pose"]) is not None:
        xx, _, yy = pose["covariance_m2"]
        page.gauge("position_sigma_meters", "Root of the summed variances of x and y.", max(xx + yy, 0.0) ** 0.5)
    page.gauge("dashboard_pages", "Open pages.", pages)
    return "\n".join(page.lines) + "\n"


def _put_links(page: _Page, state: Mapping[str, Any]) -> None:
    links = state["links"]
    page.put(
        "link_up",
        "gauge",
        "1 when that end is heard.",
        [((("link", link["name"]),), float(link["is_well"])) for link in links],
    )
    page.put(
        "link_age_seconds",
        "gauge",
        "Since the last word of that end.",
        [((("link", link["name"]),), link["age_s"]) for link in links if link["age_s"] is not None],
    )
    restarts = [((("process", name),), count) for name, count in state["restarts"].items()]
    page.put("process_restarts_total", "counter", "Times a process was started anew, as seen from here.", restarts)


def _put_mission(page: _Page, mission: Mapping[str, Any], known: Sequence[str]) -> None:
    states = [((("state", state),), float(state == mission["state"])) for state in known]
    page.put("mission_state", "gauge", "1 for the state of the mission.", states)
    counts = [((("state", name),), mission[key]) for name, key in _COUNTS.items()]
    page.put("points", "gauge", "Measurement points, or waypoints.", counts)
    page.gauge("elapsed_seconds", "Of the mission, by the robot's clock.", mission["elapsed_s"])
    page.gauge("remaining_seconds", "Estimate of what is left.", mission["eta_s"])
    page.put("late_frames_total", "counter", "Frames that were served late.", [((), mission["missed_deadlines"])])
    page.gauge("frame_lag_seconds", "How late the latest of them was.", 1e-3 * mission["worst_lateness_ms"])


_COUNTS = {"planned": "total", "measured": "done", "skipped": "skipped"}


def _put_robot(page: _Page, robot: Mapping[str, Any]) -> None:
    page.gauge("battery_charge_ratio", "Charge of the robot's battery, 0 to 1.", robot["charge"])
    fans = [((("side", side),), duty) for side, duty in zip(("left", "right"), robot["fans"], strict=True)]
    page.put("fan_duty_ratio", "gauge", "Duty of the fans, as the robot echoes it, 0 to 1.", fans)
    page.gauge("wheels_held", "1 when the robot holds its wheels by its own rules.", robot["is_held"])
    page.gauge("drive_age_seconds", "Age of the drive in force, by the robot.", robot["drive_age_s"])
    page.gauge("permit_age_seconds", "Age of the permit in force, by the robot.", robot["permit_age_s"])
    page.gauge("robot_faults", "Faults that the robot reports.", len(robot["faults"]))


def _labels(labels: Labels) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{value.translate(_ESCAPES)}"' for name, value in labels) + "}"


def _number(value: float) -> str:
    number = float(value)
    return str(int(number)) if number.is_integer() and abs(number) < 1e15 else repr(number)
