"""A strict reader of the Prometheus text format (exposition format 0.0.4), for the tests of what we print."""

import re
from typing import NamedTuple

NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"
LABEL = r'[a-zA-Z_][a-zA-Z0-9_]*="(?:[^"\\\n]|\\["\\n])*"'
SAMPLE = re.compile(rf"({NAME})(?:\{{({LABEL}(?:,{LABEL})*)\}})? (\S+)")
KINDS = ("counter", "gauge", "histogram", "summary", "untyped")


class Metric(NamedTuple):
    """A family of samples, by their labels as they stand there."""

    kind: str
    samples: dict[str, float]


def parse(text: str) -> dict[str, Metric]:
    """The metrics; raises ValueError for whatever a strict reader would refuse."""
    if not text.endswith("\n"):
        raise ValueError("the last line has no end")
    metrics: dict[str, Metric] = {}
    helped: set[str] = set()
    current = ""
    for line in text.splitlines():
        if line.startswith("# HELP "):
            name, _, told = line[7:].partition(" ")
            if name in helped or not told or not re.fullmatch(NAME, name):
                raise ValueError(f"bad help: {line}")
            helped.add(name)
        elif line.startswith("# TYPE "):
            current, _, kind = line[7:].partition(" ")
            if current in metrics or kind not in KINDS or not re.fullmatch(NAME, current):
                raise ValueError(f"bad type: {line}")
            metrics[current] = Metric(kind, {})
        else:
            matched = SAMPLE.fullmatch(line)
            if matched is None or matched[1] != current:
                raise ValueError(f"bad sample: {line}")
            labels = matched[2] or ""
            if labels in metrics[current].samples:
                raise ValueError(f"twice: {line}")
            metrics[current].samples[labels] = float(matched[3])
    for name, metric in metrics.items():
        if name not in helped or not metric.samples:
            raise ValueError(f"{name}: no help or no sample")
        if metric.kind == "counter" and not name.endswith("_total"):
            raise ValueError(f"{name}: a counter ends with _total")
    return metrics
