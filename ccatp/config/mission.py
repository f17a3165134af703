"""What the processes of a run need of a configuration, whatever its kind of mission."""

from typing import Any, Protocol, Self

from ccatp.config.models import AlarmsConfig, DashboardConfig, LinkConfig, ObservatoryConfig, ProcessesConfig


class RunSection(Protocol):
    """The section ``run``."""

    @property
    def seed(self) -> int:
        """Seed of every random draw."""


class MissionSection(Protocol):
    """The section ``mission``."""

    @property
    def verdict_timeout_s(self) -> float:
        """Age from which a verdict of the danger loop does not count any more."""


class DangerSection(Protocol):
    """The section ``danger``."""

    @property
    def stale_after_s(self) -> float:
        """Age of a frame from which no permit is given on it."""


class CommonConfig(Protocol):
    """A configuration. Each server that ``sim`` has a section for is stood in for by ``ccatp run --sim``."""

    @property
    def system(self) -> str:
        """The name by which the kind of mission is found."""

    @property
    def run(self) -> RunSection:
        """The run."""

    @property
    def processes(self) -> ProcessesConfig:
        """Time-outs, restarts and priorities of the processes."""

    @property
    def robot(self) -> LinkConfig:
        """The robot link."""

    @property
    def mission(self) -> MissionSection:
        """The mission."""

    @property
    def danger(self) -> DangerSection:
        """The danger loop."""

    @property
    def observatory(self) -> ObservatoryConfig:
        """The channel of the observatory."""

    @property
    def alarms(self) -> AlarmsConfig:
        """Alarms to other services."""

    @property
    def dashboard(self) -> DashboardConfig:
        """The web page."""

    @property
    def sim(self) -> Any:
        """The simulated servers, by the section of their clients; each has ``host`` and ``port``."""

    def model_dump(self, *, mode: str = "python") -> dict[str, Any]:
        """All values as a tree."""

    def model_copy(self, *, update: dict[str, Any] | None = None) -> Self:
        """A copy with other values."""
