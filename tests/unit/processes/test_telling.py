"""What the main loop tells of frames and fixes, as a recording needs it."""

from types import SimpleNamespace
from typing import Any, cast

import msgspec
import structlog

from ccatp.core import DeckPose, Fix, PanelId, PanelPose
from ccatp.daemon.telemetry import BATCH_FRAMES, SurveyTelemetry
from ccatp.links.bus import Publisher
from ccatp.links.topics import FixMessage, Message, SensorLines, TrackMessage
from ccatp.localizer import Localizer


class Listener:
    """Takes what is published."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, Message]] = []

    def send(self, name: str, message: Message) -> None:
        self.heard.append((name, message))

    def of(self, name: str) -> list[Any]:
        return [message for topic, message in self.heard if topic == name]


def teller() -> tuple[SurveyTelemetry, Listener]:
    listener = Listener()
    return SurveyTelemetry(cast(Publisher, listener), structlog.get_logger()), listener


def localizer() -> Localizer:
    pose = PanelPose(PanelId(1, 2), 0.1, 0.2, 0.3)
    return cast(Localizer, SimpleNamespace(pose=pose, deck_pose=DeckPose(0.0, 0.0, 0.0), position_sigma_m=1e-3))


def test_a_frame_that_is_not_newer_is_recorded_without_an_estimate() -> None:
    tells, listener = teller()
    tells.publish_frame(7, 1.0, localizer(), "driving", b'{"seq":7}')
    tells.stale_frame(8, b'{"seq":8}')
    tells.publish_frame(9, 1.01, localizer(), "driving", b'{"seq":9}')
    tells.flush()
    (lines,), (track,) = listener.of("sensors"), listener.of("track")
    assert isinstance(lines, SensorLines)
    assert isinstance(track, TrackMessage)
    assert [msgspec.json.decode(line)["seq"] for line in lines.lines] == [7, 8, 9]
    assert [row[0] for row in track.rows] == [7, 9]


def test_stale_frames_alone_are_no_batch_of_estimates() -> None:
    tells, listener = teller()
    for seq in range(BATCH_FRAMES):
        tells.stale_frame(seq, b"{}")
    assert len(listener.of("sensors")) == 1
    assert not listener.of("track")
    assert not listener.of("timing")


def test_a_fix_belongs_behind_the_last_frame_whatever_it_was() -> None:
    tells, listener = teller()
    tells.publish_frame(7, 1.0, localizer(), "measuring", b"{}")
    tells.stale_frame(8, b"{}")
    tells.publish_fix(None, Fix(1.0, (0.0, 0.0, 0.0), (0.0,) * 9, 1.0, (1,), 0.0), 0.0, is_fused=False)
    (fix,) = listener.of("fix")
    assert isinstance(fix, FixMessage)
    assert (fix.seq, fix.is_fused) == (8, False)
