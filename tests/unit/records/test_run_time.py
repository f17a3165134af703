"""One axis of time for all recordings of a run, and the alarms on it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccatp.links.topics import Alarm, MissionStatus
from ccatp.records.run_time import AlarmTimes, places_of


def timeline(*times_s: float) -> Any:
    return SimpleNamespace(t_s=np.array(times_s), period_s=0.01)


def test_later_recordings_follow_those_before_them() -> None:
    """The robot's clock begins again in each of them; one is unreadable, one has no frame."""
    parts = [("a", timeline()), ("b", timeline(5.0, 6.0)), ("c", None), ("d", timeline(0.5, 2.5)), ("e", timeline(6.0))]
    places = places_of(parts)
    assert [place.number for place in places] == [1, 2, 3, 4, 5]
    assert [place.offset_s for place in places] == pytest.approx([0.0, 0.0, 0.0, 5.51, 2.02])


def status(seq: int, *alarms: tuple[str, str]) -> MissionStatus:
    """Alarms by name and end; each was raised at U."""
    listed = [Alarm(name=name, severity="hold", cause="", advice="", since="U", since_s=0.0) for name, _ in alarms]
    for alarm, (_, ended) in zip(listed, alarms, strict=True):
        alarm.ended = ended
    return MissionStatus(seq=seq, t_s=0.0, state="held", alarms=listed)


def test_alarms_have_the_time_of_the_first_status_that_shows_their_begin_and_end() -> None:
    """One stays in the list after its end, one leaves it, one is still active."""
    statuses = [status(-1, ("stays", "")), status(1), status(2, ("stays", ""), ("leaves", ""))]
    statuses += [status(3, ("stays", "V"), ("leaves", ""), ("lasts", "")), status(4, ("stays", "V"), ("lasts", ""))]
    times = AlarmTimes([(10.0 + k, one) for k, one in enumerate(statuses)])
    assert [times.raised_s(name, "U") for name in ("stays", "leaves", "lasts")] == [12.0, 12.0, 13.0]
    assert [times.ended_s(name, "U") for name in ("stays", "leaves")] == [13.0, 14.0]
    assert np.isnan([times.ended_s("lasts", "U"), times.raised_s("stays", "another"), times.raised_s("x", "U")]).all()
