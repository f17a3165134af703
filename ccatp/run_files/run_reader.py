"""Edge. A run directory as something that can be replayed: each recording with its configuration and its messages."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.errors import CcatpError, ExitStatus
from ccatp.mirror.mirror import Mirror
from ccatp.replaying.events import Message, Stood, fix_given
from ccatp.replaying.trace import IntArray, Trace, TraceBuilder, trace_of_truth
from ccatp.run_files.recorder import iter_messages, read_metadata, recordings
from ccatp.wire.robot import BadLine, Sensors, decode_from_robot
from ccatp.wire.topics import (
    RECORD_FORMAT,
    Arrival,
    BadMessage,
    FixMessage,
    Rest,
    SensorLines,
    Track,
    Treatment,
    Truth,
    unpack,
)

_T = TypeVar("_T")
TELEMETRY = "telemetry.mcap"
CONFIG = "config.toml"
# What a replay reads; the others of the topic table would only be decoded for nothing.
READ = frozenset(("sensors", "rest", "treatment", "fix", "track", "truth", "arrival"))


class RunReadError(CcatpError):
    """A run that cannot be read."""

    exit_status = ExitStatus.USAGE


@dataclass(slots=True)
class Recording:
    """One recording of a run; a run that was resumed has several, each from the robot's start at base.

    Attributes:
        path: the file.
        metadata: what the recorder was told.
        warnings: what is wrong with it; complete when ``messages`` has come to its end.
        arrivals: frames at which the robot stood at a point for the first time; complete likewise.
    """

    path: Path
    metadata: Mapping[str, str]
    warnings: list[str] = field(default_factory=list)
    arrivals: list[int] = field(default_factory=list)
    _track: TraceBuilder = field(default_factory=TraceBuilder)
    _truth: list[tuple[float, ...]] = field(default_factory=list)
    _lost: int = 0

    @property
    def is_simulation(self) -> bool:
        """It was recorded of the stand-ins."""
        return self.metadata.get("simulation") == "true"

    def config(self, overrides: Mapping[str, object]) -> Config:
        """The configuration that was recorded with, and ``overrides`` on top.

        Raises:
            ConfigError: it cannot be used.
        """
        beside = self.path.with_name(CONFIG)
        kept = self.metadata.get("config")
        if kept is None or (beside.is_file() and _text(beside) == kept):
            return load_config(beside, overrides)
        # A later session of a resumed run has written its own.
        with tempfile.TemporaryDirectory(prefix="ccatp-replay-") as folder:
            file = Path(folder) / CONFIG
            file.write_text(kept, encoding="utf-8")
            return load_config(file, overrides)

    def messages(self) -> Iterator[Message]:
        """Frames, rests and fixes, in the order of recording; estimates and truth are put aside on the way."""
        last, missing, t_s = -1, 0, 0.0
        damages: list[str] = []
        for topic, _, payload in iter_messages(self.path, damages.append):
            if topic not in READ:
                continue
            try:
                found = self._take(unpack(topic.encode() + b" " + payload)[2])
            except (BadMessage, BadLine) as error:
                self._lose(str(error))
                continue
            for message in found:
                if isinstance(message, Sensors):
                    missing += message.seq - last - 1 if last >= 0 else 0
                    last, t_s = message.seq, message.t
                yield message
        self.warnings += [f"{damage}; its last frame is of {t_s:.2f} s" for damage in damages]
        if missing:
            self.warnings.append(f"{self.path}: {missing} frames are missing in between")

    def _take(self, message: object) -> list[Message]:
        """What a message holds for the localizer."""
        if isinstance(message, SensorLines):
            frames = [decode_from_robot(bytes(line)) for line in message.lines]
            return [frame for frame in frames if isinstance(frame, Sensors)]
        if isinstance(message, Rest):
            return [Stood(message.seq)]
        if isinstance(message, Treatment):
            return [message]
        if isinstance(message, FixMessage):
            return [fix_given(message)]
        if isinstance(message, Track):
            for seq, t_s, row, col, x_m, y_m, heading_rad, _ in message.rows:
                self._track.add(seq, t_s, row, col, (x_m, y_m, heading_rad))
        elif isinstance(message, Truth):
            self._truth += message.rows
        elif isinstance(message, Arrival):
            self.arrivals.append(message.seq)
        return []

    def _lose(self, why: str) -> None:
        """A message that cannot be read: one line says so, however many there are."""
        self._lost += 1
        if self._lost == 1:
            self.warnings.append(f"{self.path}: what cannot be read is left out: {why}")

    def recorded(self, mirror: Mirror) -> Trace:
        """What the run itself estimated."""
        return self._track.build(mirror)

    def truth(self) -> Trace | None:
        """The simulated truth, where there is one."""
        return trace_of_truth(np.array(self._truth)) if self._truth else None

    def arrival_frames(self) -> IntArray:
        """``arrivals`` as an array."""
        return np.array(self.arrivals, dtype=np.int64)


def open_run(run_dir: Path) -> list[Recording]:
    """The recordings of a run directory, oldest first.

    Raises:
        RunReadError: there is no such directory, it holds no recording or no configuration, or one of a newer format.
    """
    if not run_dir.is_dir():
        raise RunReadError(f"{run_dir}: no such directory; name the directory of a run")
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        raise RunReadError(f"{run_dir}: no {TELEMETRY} there; name the directory of a run")
    return [_open(path) for path in paths]


def _open(path: Path) -> Recording:
    metadata = _readable(path, read_metadata)
    number = metadata.get("format", "0")
    if not number.isdecimal() or int(number) > RECORD_FORMAT:
        raise RunReadError(
            f"{path}: recorded in format {number} by ccatp {metadata.get('ccatp', 'unknown')}, this one reads "
            f"up to {RECORD_FORMAT}: replay it with a newer ccatp"
        )
    if "config" not in metadata and not path.with_name(CONFIG).is_file():
        raise RunReadError(f"{path.parent}: no {CONFIG} there; name the directory of a run")
    return Recording(path, metadata)


def _text(path: Path) -> str:
    return _readable(path, lambda file: file.read_text(encoding="utf-8", errors="replace"))


def _readable(path: Path, read: Callable[[Path], _T]) -> _T:
    try:
        return read(path)
    except OSError as error:
        raise RunReadError(f"{path}: cannot be read: {error.strerror or error}") from error
