"""The golden cases, in names of the base (``renames.toml``).

A step is a command line of ``ccatp`` and what happens meanwhile. In its arguments ``{run}`` is the run directory of the
case, ``{root}`` the source tree, ``{data}`` the folder of recorded radio data, ``{here}`` this folder.
"""

from dataclasses import dataclass
from typing import Any

_EMERGENCY_ID = "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"
_SETTLING_S = 3.0  # the recorder writes after a second at the latest; what is written survives the end by ``kill -9``
_REPLY_S = 10.0
_PAUSE_S = 1.0  # the reply comes when the robot is at rest, which takes frames: longer than it takes to be received


@dataclass(frozen=True)
class Action:
    """What happens before a frame: a request to a socket of the runtime directory, or the end by ``kill -9``."""

    frame: int
    socket: str = ""
    request: dict[str, Any] | None = None
    wait_s: float = _REPLY_S

    def resolved(self, runtime_dir: str) -> dict[str, Any]:
        """The action in the form that the hook reads."""
        if self.request is None:
            return {"frame": self.frame, "kill": _SETTLING_S}
        endpoint = f"ipc://{runtime_dir}/{self.socket}"
        return {"frame": self.frame, "endpoint": endpoint, "request": self.request, "wait_s": self.wait_s}


@dataclass(frozen=True)
class Step:
    """One command. ``is_run``: it has a run directory and a runtime directory of its own."""

    arguments: tuple[str, ...]
    actions: tuple[Action, ...] = ()
    is_run: bool = False


@dataclass(frozen=True)
class Case:
    """A name, the steps one after the other, and what is compared: everything, or the final results alone."""

    name: str
    steps: tuple[Step, ...]
    is_quick: bool = False
    only_results: bool = False
    needs_data: bool = False


def _survey(*arguments: str, actions: tuple[Action, ...] = ()) -> Step:
    ports = ("--set", "sim.robot.port=0", "--set", "sim.etalon.port=0", "--set", "dashboard.port=0")
    return Step(("run", "--sim", "--run-dir", "{run}", *ports, *arguments), actions, is_run=True)


def _beacons(system: str) -> Step:
    ports = ("--set", "sim.robot.port=0", "--set", "dashboard.port=0")
    config = f"{{root}}/configs/{system}.toml"
    return Step(("run", "--sim", "--run-dir", "{run}", "--config", config, *ports), is_run=True)


def _emergency(kind: str, frame: int) -> Action:
    return Action(frame, "emergency", {"cmd": "emergency", "kind": kind, "id": _EMERGENCY_ID, "note": "golden"})


def _clear(frame: int) -> Action:
    return Action(frame, "emergency", {"cmd": "clear", "id": _EMERGENCY_ID})


def _surveys() -> list[Case]:
    return [
        Case(f"survey-{mirror}-{world}", (_survey("--mirror", mirror, "--world", world, "--panels", "2"),))
        for mirror in ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
        for world in ("thesis", "hard", "extreme")
    ]


def _emergencies() -> list[Case]:
    one = ("--panels", "1")
    cases = [
        Case(f"emergency-{kind}", (_survey(*one, actions=(_emergency(kind, 1200),)),), is_quick=kind == "fire")
        for kind in ("fire", "power", "weather", "operator")
    ]
    # Frames come at ten a second meanwhile: it is over after three seconds.
    shaking = (_emergency("earthquake", 1200), _clear(1230))
    return [*cases, Case("emergency-earthquake", (_survey(*one, actions=shaking),))]


def _radio() -> list[Case]:
    data = {
        "plaza": "{data}/plaza/Plaza2_.mat",
        "mrclam": "{data}/mrclam/set7",
        "labyrinth": "{data}/uwb_labyrinth/labyrinth_0_600s.txt.gz",
    }
    cases = [
        Case(
            f"radio-slam-{name}",
            tuple(Step(("radio", "slam", path, "--filter", kind, "--json")) for kind in ("ekf-slam", "smoother")),
            is_quick=name == "plaza",
            needs_data=True,
        )
        for name, path in data.items()
    ]
    ranges = ("radio", "map", "--ranges", "{data}/uwb_planar/session_8_14.csv", "--json")
    simulated = ("radio", "map", "--json")
    return [
        *cases,
        Case("radio-map-recorded", (Step(ranges), Step((*ranges, "--offset"))), is_quick=True, needs_data=True),
        Case("radio-map-simulated", (Step(simulated), Step((*simulated, "--method", "ekf"))), is_quick=True),
    ]


def _others() -> list[Case]:
    killed = _survey("--panels", "2", actions=(Action(6000),))
    recorded = (
        _survey("--mirror", "thesis-m2", "--world", "hard", "--panels", "1"),
        Step(("align", "{run}", "--json")),
        Step(("replay", "{run}", "--json")),
        Step(("replay", "{run}", "--filter", "ukf", "--json")),
    )
    operator = (
        Action(1000, "control", {"cmd": "pause"}, _PAUSE_S),
        Action(1030, "control", {"cmd": "resume"}),
        Action(3000, "control", {"cmd": "abort"}),
    )
    plans = tuple(
        Step(("plan", "--mirror", mirror, "--json")) for mirror in ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
    )
    return [
        Case("align", recorded, is_quick=True),
        Case("resume", (killed, _survey("--panels", "2", "--resume")), only_results=True),
        Case("operator", (_survey("--panels", "1", actions=operator),)),
        Case("faults", (_survey("--panels", "1", "--faults", "{here}/fault_plan.toml"),)),
        *(Case(f"filter-{name}", (_survey("--panels", "1", "--filter", name),)) for name in ("kf", "ukf")),
        *(
            Case(f"beacons-{name}", (_beacons(name),), is_quick=name == "cricket")
            for name in ("zigbee", "follow", "cricket")
        ),
        Case("plan", plans),
    ]


CASES: tuple[Case, ...] = (*_surveys(), *_emergencies(), *_others(), *_radio())
