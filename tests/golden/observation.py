"""What a golden case left behind, as streams of rows: the robot link, the recording, the log, summaries and JSON."""

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader

Key = tuple[int | str, ...]
Row = tuple[Key, dict[str, Any]]
Observation = dict[str, list[Row]]

# Levels that are repeated on the machine's clock: where they ended is a function of the seed, when they were sent not.
LAST_ONLY = frozenset(("mission", "beacon_map"))
_LOG_FRAME = "seq"
# Messages of the robot link that begin a session: who comes first is a matter of time.
_SESSION = frozenset(("hello", "join", "joined"))
# Keys of a log line that say who wrote it and when.
_LOG_HEAD = frozenset(("event", "level", "logger", "process", "seq", "timestamp", "wall"))


def observe(folder: Path, *, only_results: bool) -> Observation:
    """Everything that may be compared of a case, in names of the tree that ran it."""
    found: defaultdict[str, list[Row]] = defaultdict(list)
    for path in sorted(folder.glob("exit.*")):
        found["exit"].append(((path.suffix[1:],), {"status": int(path.read_text())}))
    for path in sorted(folder.glob("out.*")):
        if (data := _json_of(path.read_text())) is not None:
            found["json"].append(((path.suffix[1:],), dict(flatten(data, path.suffix[1:]))))
    summary = folder / "run" / "summary.json"
    if summary.exists():
        found["summary"].append(((0,), dict(flatten(_json_of(summary.read_text())))))
    if not only_results:
        _observe_course(folder, found)
    return dict(found)


def _observe_course(folder: Path, found: defaultdict[str, list[Row]]) -> None:
    """What happened frame by frame."""
    replies = folder / "replies"
    if replies.exists():
        for k, line in enumerate(replies.read_text().splitlines()):
            found["replies"].append(((k,), dict(flatten(_json_of(line), "reply"))))
    for part, path in enumerate(sorted(folder.glob("wire.*"))):
        found["frames"] += _frames(path, part)
    for path in sorted(folder.glob("bus.*")):
        for topic, row in _published(path):
            found[f"bus:{topic}"].append(row)
    for part, path in enumerate(sorted((folder / "run").glob("*.mcap"))):
        for topic, key, fields in _recorded(path):
            found[topic].append(((part, *key), fields))
    log = folder / "run" / "log.jsonl"
    if log.exists():
        for name, row in _events(log):
            found[f"event:{name}"].append(row)
    for topic in LAST_ONLY & found.keys():
        found[topic] = [((0,), found[topic][-1][1])]


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers, texts and so on of a JSON value by their paths, as ``panels.0.tip``."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from flatten(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value:
        for k, inner in enumerate(value):
            yield from flatten(inner, f"{path}.{k}" if path else str(k))
    else:
        yield path, value


def _json_of(text: str | bytes) -> Any:
    """The value, ``None`` where the text is no JSON; 0 and 0.0 are the same number."""
    try:
        return json.loads(text, parse_int=float)
    except ValueError:
        return None


def _fields(message: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Fields of a message that comes in every frame; lists as text, which takes a tenth of the memory."""
    return {
        f"{prefix}{key}": json.dumps(value) if isinstance(value, list | dict) else value
        for key, value in message.items()
    }


def _frames(path: Path, part: int) -> Iterator[Row]:
    """A row per sensors frame of the robot link: what the robot sent, and what it received in answer."""
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    boots: list[int] = []
    newest = -1
    for line in path.read_bytes().splitlines():
        text = line[1:].decode("utf-8", "replace")
        message = _json_of(text)
        if not isinstance(message, dict):
            message = {"type": "malformed", "line": text}
        kind, seq = str(message.pop("type", "")), int(message.pop("seq", -1))
        if kind == "hello" and message["boot"] not in boots:
            boots.append(message["boot"])
        if kind in _SESSION:
            continue
        if kind == "sensors":
            newest = frame = seq
        else:
            frame = int(message.pop("ack", newest))  # what has no number of a frame belongs to the newest one
        row = rows.setdefault((len(boots), frame), {})
        row.update(_fields(message, f"{kind}."))
    for (boot, seq), row in sorted(rows.items()):
        yield (part, boot, seq), row


def _recorded(path: Path) -> Iterator[tuple[str, Key, dict[str, Any]]]:
    """Topic, frame and fields of each message, and of each row of a batch: where batches end is a matter of time."""
    with path.open("rb") as file:
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            data = _json_of(message.data)
            batch = data.get("rows", data.get("lines"))
            if batch is None:
                yield channel.topic, (int(data.get("seq", -1)),), data
                continue
            for row in batch:
                is_list = isinstance(row, list)
                fields = {str(k): value for k, value in enumerate(row)} if is_list else _fields(row)
                yield channel.topic, (int(row[0] if is_list else row.get("seq", -1)),), fields


def _published(path: Path) -> Iterator[tuple[str, Row]]:
    for line in path.read_bytes().splitlines():
        topic, _, text = line.decode("utf-8", "replace").partition(" ")
        fields = _json_of(text)
        if isinstance(fields, dict):
            yield topic, ((int(fields.get("seq", -1)),), fields)


def _events(path: Path) -> Iterator[tuple[str, Row]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        event = _json_of(line)
        if isinstance(event, dict) and isinstance(event.get(_LOG_FRAME), float):
            fields = {key: value for key, value in event.items() if key not in _LOG_HEAD}
            yield str(event["event"]), ((int(event[_LOG_FRAME]),), fields)
