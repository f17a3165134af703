"""Glue. Collects a mission among beacons from the bus for its summary."""

from typing import Any

from ccatp.beacon_summary import BeaconSummary, Reached, beacon_facts
from ccatp.config.radio_loader import dump_radio_config
from ccatp.config.radio_models import RadioConfig
from ccatp.supervision.collecting import Collector, RunAccess
from ccatp.wire.topics import (
    BeaconArrival,
    BeaconMap,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    DangerEvent,
    Message,
    MissionStatus,
    Timing,
)


class BeaconCollector(Collector):
    """Listens to a mission among beacons from its start to its end.

    Args:
        access: how it is reached.
        cfg: the run's configuration.
    """

    def __init__(self, access: RunAccess, cfg: RadioConfig) -> None:
        """Subscribe before anybody publishes."""
        metadata = {"system": cfg.system, "seed": str(cfg.run.seed), "config": dump_radio_config(cfg)}
        super().__init__(access, metadata)
        self._summary = BeaconSummary(beacon_facts(cfg, is_sim=access.is_sim))
        self._signal = ""

    def take(self, message: Message) -> None:
        """A message for the summary."""
        summary = self._summary
        if isinstance(message, BeaconTrack):
            summary.add_track(message.rows)
        elif isinstance(message, BeaconTruth):
            summary.add_truth(message.rows)
        elif isinstance(message, BeaconPlaces):
            summary.set_places(message.places)
        elif isinstance(message, BeaconMap):
            score = message.nis_sum, message.nis_size, message.refused
            summary.set_map(message.beacons, score, message.notes)
        elif isinstance(message, BeaconArrival):
            summary.add_reached(Reached(message.seq, message.estimate))
        elif isinstance(message, Timing):
            summary.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.signal and message.signal != self._signal:
                summary.add_danger(message.signal)
            self._signal = message.signal
        elif isinstance(message, MissionStatus):
            summary.set_mission(message.elapsed_s, message.outcome, message.cause)

    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json`` of what was collected."""
        return self._summary.build(wall_s)
