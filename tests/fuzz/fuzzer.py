"""A corpus-mutating fuzzer: seeded, repeatable, guided by the outcomes that it has not seen before."""

import random
import re
import traceback
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field

MAX_CORPUS = 400
MAX_INPUT = 20_000
FRESH = 0.1  # share of inputs that are mutations of a seed and not of what grew from it

NUMBERS = (
    b"0 -0 1 -1 2 3 7 9 255 256 65535 2147483648 4294967296 9223372036854775807 9223372036854775808 "
    b"18446744073709551616 1e9 1e308 1e309 -1e309 5e-324 1e-400 0.1 .5 5. 00 01 0x10 1_000 NaN nan Infinity -Infinity "
    b"inf null true false +1 "
    b'"" [] {} "a"'
).split()
TOKENS = (
    *(b"{ } [ ] , : \" ' \\ \n \r\n \x00 \xff \xc3\x28 \xed\xa0\x80 # = _ - \t".split(b" ")),
    b"\\u0000",
    b"\\ud800",
    b'"type":',
    b'"seq":',
    b'"cmd":',
    b"[[fault]]",
    b"[x]",
    b"1" * 400,
    b"[" * 2000,
    b"\xef\xbb\xbf",
    "\u0661\u00b2".encode(),
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_VARYING = re.compile(r"\d+|'.*'|\".*\"|\bnan\b|\binf\b")


@dataclass(frozen=True, slots=True)
class Target:
    """What is fuzzed.

    Attributes:
        name: for people.
        seeds: inputs that are good.
        run: takes an input; its result tells outcomes apart.
        refusals: the exceptions that the decoder promises; any other is a failure.
    """

    name: str
    seeds: Sequence[bytes]
    run: Callable[[bytes], Hashable]
    refusals: tuple[type[Exception], ...]


@dataclass(slots=True)
class Report:
    """What a fuzz run found."""

    name: str
    inputs: int = 0
    accepted: int = 0
    outcomes: set[Hashable] = field(default_factory=set)
    failures: list[str] = field(default_factory=list)

    @property
    def line(self) -> str:
        return (
            f"{self.name}: {self.inputs} inputs, {self.accepted} accepted, {len(self.outcomes)} distinct outcomes, "
            f"{len(self.failures)} failures"
        )


def fuzz(target: Target, inputs: int, seed: int) -> Report:
    """Run so many inputs; stops after a few failures."""
    rng = random.Random(f"{target.name} {seed}")
    report = Report(target.name)
    corpus = list(target.seeds)
    for data in corpus:
        one(target, data, report)
    assert report.accepted == len(corpus), f"{target.name}: a seed is refused"
    for _ in range(inputs):
        parent = target.seeds[rng.randrange(len(target.seeds))] if rng.random() < FRESH else rng.choice(corpus)
        data = mutated(rng, parent, corpus)
        if one(target, data, report):
            if len(corpus) < MAX_CORPUS:
                corpus.append(data)
            else:
                corpus[rng.randrange(len(target.seeds), MAX_CORPUS)] = data
        if len(report.failures) >= 5:
            break
    return report


def one(target: Target, data: bytes, report: Report) -> bool:
    """Run one input; returns whether its outcome is new."""
    report.inputs += 1
    try:
        outcome: Hashable = ("ok", target.run(data))
        report.accepted += 1
    except target.refusals as refusal:
        outcome = type(refusal).__name__, _VARYING.sub("_", str(refusal))[:80]
    except Exception as error:  # whatever it is, it is the finding
        outcome = type(error).__name__, traceback.format_exc(limit=-2)
        report.failures.append(f"{target.name}: {data!r}: {outcome[1]}")
    known = len(report.outcomes)
    report.outcomes.add(outcome)
    return len(report.outcomes) > known


def mutated(rng: random.Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """The input with one to four changes."""
    for _ in range(1 + int(rng.expovariate(1.2))):
        data = _MUTATORS[int(rng.random() * len(_MUTATORS))](rng, data, corpus)
    return data[:MAX_INPUT]


def _flip(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    if not data:
        return b"\x00"
    at = rng.randrange(len(data))
    return data[:at] + bytes((data[at] ^ (1 << rng.randrange(8)),)) + data[at + 1 :]


def _overwrite(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(1 + rng.randrange(4)) + data[at + 1 :]


def _delete(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + 1 + int(rng.expovariate(0.2)) :]


def _truncate(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _repeat(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    length = 1 + int(rng.expovariate(0.1))
    return data[:at] + data[at : at + length] * (2 + rng.randrange(3)) + data[at + length :]


def _splice(rng: random.Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    other = corpus[rng.randrange(len(corpus))]
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _token(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(TOKENS) + data[at + rng.randrange(2) :]


def _number(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    found = _NUMBER.search(data, at) or _NUMBER.search(data)
    return data if found is None else data[: found.start()] + rng.choice(NUMBERS) + data[found.end() :]


def _word(rng: random.Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """Exchange two stretches between separators."""
    parts = re.split(rb"([,:_\n=]+)", data)
    if len(parts) < 3:
        return _splice(rng, data, corpus)
    a, b = rng.randrange(len(parts)), rng.randrange(len(parts))
    parts[a], parts[b] = parts[b], parts[a]
    return b"".join(parts)


_MUTATORS = (_flip, _overwrite, _delete, _truncate, _repeat, _splice, _token, _token, _number, _number, _number, _word)
