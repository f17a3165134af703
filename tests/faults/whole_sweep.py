"""The whole edge sweep, in blocks: every drive over the rim, every turn beside it, 300,000 ways over seams.

``make sweep`` runs it, five to nine hours of one core. Each block is a line of ``blocks.jsonl``. A stopped sweep
goes on there; what another build swept does not count.
"""

import argparse
import hashlib
import json
import random
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import ccatp
from tests.faults import edge_sweep
from tests.faults.edge_sweep import OVERRUN_M, Tally, rim_case, rim_cases, seam_case, sweep, turn_case, turn_cases

BLOCK = 4000  # drives: some seconds
SEAMS = 300_000  # no false edge in as many says one in 100,000 at most, with 95 %
KINDS: dict[str, tuple[Callable[[int], tuple[str, Callable[[], Tally]]], Callable[[], int]]] = {
    "rim": (rim_case, rim_cases),
    "turn": (turn_case, turn_cases),
    "seam": (seam_case, lambda: SEAMS),
}
Block = tuple[str, int]


def build() -> str:
    """What sweeps: a change of any file of the package, or of the drives, is another build."""
    digest = hashlib.sha256(Path(edge_sweep.__file__).read_bytes())
    root = Path(ccatp.__file__).parent
    for path in sorted(path for path in root.rglob("*") if path.suffix in {".py", ".so", ".toml"}):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def blocks() -> list[Block]:
    """All of them, mixed: what has been swept at any time is a sample of the whole."""
    found = [(kind, first) for kind, (_, count) in KINDS.items() for first in range(0, count(), BLOCK)]
    random.Random(9).shuffle(found)
    return found


def run(block: Block) -> tuple[Block, Tally]:
    """The drives of a block."""
    kind, first = block
    case, count = KINDS[kind]
    return block, sweep(case, range(first, min(first + BLOCK, count())))


def run_all(todo: list[Block], workers: int) -> Iterator[tuple[Block, Tally]]:
    """Blocks as they are done."""
    if workers == 1:
        yield from map(run, todo)
        return
    with get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(run, todo)


def is_good(tally: Tally) -> bool:
    """Nobody fell, no edge was missed, none was false, and all stood in time."""
    return not (tally.falls or tally.unseen or tally.false_edges) and tally.after_m <= OVERRUN_M


def read(path: Path, its_build: str) -> dict[Block, Tally]:
    """What this build swept before; a line that was cut off is swept again."""
    done: dict[Block, Tally] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if row["build"] == its_build:
            done[row["kind"], row["first"]] = Tally(**row["tally"])
    return done


def total(tallies: Iterable[Tally]) -> Tally:
    """Of several blocks."""
    of_all = Tally()
    for tally in tallies:
        of_all.add(tally)
    return of_all


def main(arguments: list[str]) -> int:
    """0 if what has been swept is good, 1 if not."""
    parser = argparse.ArgumentParser(prog="whole_sweep", description=__doc__)
    parser.add_argument("dir", type=Path, metavar="DIR", help="where blocks.jsonl lies or shall lie")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--blocks", type=int, metavar="N", help="stop after so many")
    args = parser.parse_args(arguments)
    args.dir.mkdir(parents=True, exist_ok=True)
    path, its_build = args.dir / "blocks.jsonl", build()
    every, done = blocks(), read(path, its_build)
    todo = [block for block in every if block not in done][: args.blocks]
    print(f"{len(done)} of {len(every)} blocks are done, {len(todo)} to do", flush=True)
    with path.open("a") as file:
        file.write("\n")  # the line before may have been cut off
        for block, tally in run_all(todo, args.workers):
            done[block] = tally
            row = {"build": its_build, "kind": block[0], "first": block[1], "tally": asdict(tally)}
            file.write(json.dumps(row) + "\n")
            file.flush()
            if not is_good(tally):
                print(*tally.worst, sep="\n", flush=True)
    for kind in KINDS:
        of_kind = [tally for block, tally in done.items() if block[0] == kind]
        print(f"{kind}: {len(of_kind)} of {sum(block[0] == kind for block in every)} blocks, {total(of_kind).line}")
    return 0 if is_good(total(done.values())) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
