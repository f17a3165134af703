"""``ccatp radio map --cricket``: the map from the serial lines of listeners is that of the simulated motes."""

import os
import pty
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.datasets.cricket_logs import listen
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.sim.motes import MoteField
from ccatp.beacons.sim.robot import motes_of
from tests.support.command import answered, refused
from tests.support.scenario import radio_config_of

PLACES = {"A": (0.0, 0.0), "B": (2.0, 0.1), "C": (0.3, 1.8), "D": (2.2, 2.4), "E": (1.1, 1.0)}
MAPPED = {name: {"place_m": list(place), "facing": [1.0, 0.0]} for name, place in PLACES.items()}


def unique_id(mote: str) -> str:
    return f"1:{ord(mote):x}:61:61:b:0:0:42"


def line(sender: str, delay_s: float, stamp: int, space: bool = True, number: str = "") -> str:
    flight_us = round(1e6 * delay_s)
    name = sender if space else ""
    where = f"ID={number or unique_id(sender)},SP={name}"
    return f"VR=2.0,{where},DB={round(34400 * delay_s)},DR={flight_us},TM={flight_us + 358},TS={stamp}"


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    """A file for each listener: its report, and what it received, with damage."""
    cfg = radio_config_of(
        "cricket", cricket__layout="motes", cricket__motes=MAPPED, cricket__sim__temperature_c=26.0,
    )  # fmt: skip
    motes = motes_of(cfg)
    assert motes is not None
    rng = np.random.default_rng(3)
    field = MoteField(cfg.cricket, motes, rng)
    files = []
    for listener, name in enumerate(motes.names):
        lines = ["Cricket configuration:", "Mode: Listener", f"Space id: {name}",
                 "Local temperature value (Celsius): 26"]  # fmt: skip
        for sender in range(len(motes.names)):
            if sender == listener:
                continue
            (pulse,) = field.listen([(sender, listener)], 60, rng)
            for stamp, delay_s in enumerate(pulse.delays_s.tolist()):
                lines.append(line(motes.names[sender], delay_s, 700 * stamp))
            lines += [lines[-1], lines[-1][:60], "VR=2.0,ID=1:41:61:61:b:0:0:42,SP=A,TS=5", "\x00\x12garbage"]
        files.append(tmp_path / f"log{listener}.txt")
        files[-1].write_text("\r\n".join(lines) + "\r\n")
    return files


def test_the_map_of_the_lines_is_that_of_the_motes(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text("name,x_m,y_m\n" + "\n".join(f"{name},{x},{y}" for name, (x, y) in PLACES.items()) + "\n")
    sources = [text for file in logs for text in ("--cricket", file)]
    found = answered(capsys, "radio", "map", *sources, "--truth", truth)
    assert found["motes"] == 5
    assert found["rms_m"]["p50"] < 0.003  # 7 mm for one reading, 60 of each pair in both directions
    assert found["warnings"] == []
    # Without the temperatures of the reports the map is as much too small as sound is faster: 1 % at 26 degrees.
    for file in logs:
        file.write_text(file.read_text().replace(": 26", ": disabled"))
    cold = answered(capsys, "radio", "map", *sources, "--truth", truth)
    assert cold["rms_m"]["p50"] > 0.008
    assert "reports no temperature: 20 C of cricket.air is used" in cold["warnings"][0]


def test_what_cannot_be_read_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty, log = tmp_path / "empty.txt", tmp_path / "log.txt"
    empty.write_text("hello\nVR=2.0,ID=1:41:61:61:b:0:0:42,SP=A,TS=5\n")
    log.write_text(line("A", 0.005, 1) + "\n")
    said = refused(capsys, "radio", "map", "--cricket", empty)
    assert "has no pulse of a Cricket mote; 1 radio messages without a pulse, 0 damaged samples, 1 other lines" in said
    assert "no such file" in refused(capsys, "radio", "map", "--cricket", tmp_path / "none.txt")
    assert "is the name of two listeners" in refused(
        capsys, "radio", "map", "--cricket", f"X={log}", "--cricket", f"X={log}"
    )
    assert "--cricket and --ranges" in refused(capsys, "radio", "map", "--cricket", log, "--ranges", log)


def mapped(capsys: pytest.CaptureFixture[str], tmp_path: Path, *sources: object) -> dict[str, Any]:
    """The map of some logs, compared with the true places."""
    truth = tmp_path / "truth.csv"
    truth.write_text("name,x_m,y_m\n" + "\n".join(f"{name},{x},{y}" for name, (x, y) in PLACES.items()) + "\n")
    arguments = [text for source in sources for text in ("--cricket", source)]
    found: dict[str, Any] = answered(capsys, "radio", "map", *arguments, "--truth", truth)
    return found


def each_log(logs: list[Path], change: Callable[[str], str]) -> None:
    for log in logs:
        log.write_bytes(change(log.read_text()).encode())


def test_how_a_log_was_written_changes_no_map(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = mapped(capsys, tmp_path, *logs)
    each_log(logs, lambda text: "\ufeff\r\n" + text.replace("\n", "\r\n\r\n").rstrip())
    assert mapped(capsys, tmp_path, *logs) == plain
    # A clock that jumps back, and lines without the space id, or with one that lacks a letter.
    each_log(logs, lambda text: text.replace("TS=28000", "TS=3").replace("SP=A,DB=6", "SP=,DB=6"))
    assert mapped(capsys, tmp_path, *logs) == plain
    # Listeners that the user calls by other names are the motes that the others hear under their own.
    each_log(logs, lambda text: text)
    named = [f"{name}={log}" for name, log in zip("VWXYZ", logs, strict=True)]
    reported = zip(logs, MAPPED, strict=True)
    for log, mote in reported:
        log.write_text(f"Unique id: {unique_id(mote)}\n" + log.read_text())
    arguments = [text for source in named for text in ("--cricket", source)]
    assert answered(capsys, "radio", "map", *arguments)["motes"] == 5


def test_each_pulse_has_the_temperature_of_its_time(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = mapped(capsys, tmp_path, *logs)
    # In the evening it is cold; nothing is received any more.
    each_log(logs, lambda text: text + "Local temperature value (Celsius): -10\n")
    assert mapped(capsys, tmp_path, *logs)["rms_m"] == plain["rms_m"]


def test_motes_with_one_name_are_refused_and_many_damaged_lines_are_reported(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logs[1]
    whole = log.read_text()
    log.write_text(whole + "\n".join(line("A", 0.011, k, number="1:99:61:61:b:0:0:42") for k in range(20)))
    said = refused(capsys, "radio", "map", *(text for one in logs for text in ("--cricket", one)))
    assert "A: is the space id of several motes; give each another one (P SP)" in said
    log.write_text(whole + "\n".join(line("A", 0.011, k)[:48] for k in range(40)))
    warning, *more = mapped(capsys, tmp_path, *logs)["warnings"]
    assert not more
    assert warning.startswith("B: 44 samples are damaged or repeat a time stamp")


def test_a_mote_without_a_name_is_known_by_its_id_and_a_listener_by_its_file(tmp_path: Path) -> None:
    log = tmp_path / "porch.txt"
    log.write_text(line("A", 0.005, 1, space=False))
    found = listen(str(log), 1.0)
    assert found.name == "porch"
    assert [pulse.unique_id for pulse in found.pulses] == ["01:41:61:61:0b:00:00:42"]
    assert listen(f"hall={log}", 1.0).name == "hall"


def test_a_device_is_read_live() -> None:
    master, slave = pty.openpty()
    device = os.ttyname(slave)

    def write() -> None:
        for k in range(20):  # opening the port drops what came before
            os.write(master, (line("A", 0.005, k) + "\r\n").encode())
            time.sleep(0.05)

    writer = threading.Thread(target=write)
    writer.start()
    found = listen(f"N1={device}", 0.6)
    writer.join()
    os.close(master)
    os.close(slave)
    assert found.name == "N1"
    assert 3 <= len(found.pulses) <= 20
    assert {pulse.delay_s for pulse in found.pulses} == {0.005}


def test_a_device_that_is_none_is_refused() -> None:
    with pytest.raises(RadioDataError):
        listen("/dev/null", 0.2)
