"""A survey on the wall clock for as long as ``CCATP_SOAK_MINUTES`` says: nothing grows."""

import os
import time

import numpy as np
import pytest

from tests.faults.linking import Measured
from tests.processes.conftest import Start

MINUTES = float(os.environ.get("CCATP_SOAK_MINUTES", "3"))
WARM_UP_S = 900.0  # at most: what is done for the first time brings its modules and its memory along
SLOPE_MINUTES = 20.0  # a page more or less would be MiB an hour in a shorter time
MIB = float(1 << 20)
# 62 minutes with half a second a point, and a second and a half more at 783 points: longer than warm-up and soak.
AN_HOUR_AND_MORE = ("--mirror", "thesis-m1", "--set", "etalon.measuring_time_s=2.0")
LOOPS = ("main", "danger")


@pytest.mark.slow
@pytest.mark.fault("P12")
def test_nothing_grows(start: Start, measured: Measured) -> None:
    run = start("--realtime", "--world", "hard", "--filter", "ekf", *AN_HOUR_AND_MORE)
    run.until(lambda status: status["state"] == "driving")
    time.sleep(min(WARM_UP_S, 20.0 * MINUTES))  # a third of a short soak
    loops = {name: run.child(name) for name in LOOPS}
    begun_s = time.monotonic()
    rows: dict[str, list[tuple[float, float, int, int]]] = {name: [] for name in LOOPS}
    while time.monotonic() - begun_s < 60.0 * MINUTES:
        assert run.process.poll() is None, run.wait()
        for name, process in loops.items():
            with process.oneshot():
                memory_mib = process.memory_info().rss / MIB
                rows[name].append((time.monotonic() - begun_s, memory_mib, process.num_fds(), process.num_threads()))
        time.sleep(1.0)
    slips = run.ask("status")["status"]["missed_deadlines"]
    run.end()
    for name, table in rows.items():
        times_s, memory_mib, descriptors, threads = np.array(table).T
        print(name, "MiB each minute:", *np.round(memory_mib[::60], 2))
        measured("P12", memory_mib.max())
        # A connection or a file of the moment may be open at a look, but half of the looks see the same.
        half = len(table) // 2
        assert np.median(descriptors[:half]) == np.median(descriptors[half:])
        assert descriptors.max() - descriptors.min() <= 2
        assert threads.min() == threads.max()
        if MINUTES >= SLOPE_MINUTES:
            measured("P12", 3600.0 * np.polyfit(times_s, memory_mib, 1)[0], "MiB_per_h")
    log = (run.run_dir / "log.jsonl").read_text()
    assert "never retrieved" not in run.stderr + log
    assert "Traceback" not in run.stderr
    assert isinstance(slips, int)  # told, however many they are
