"""Every command that reads a recording, over recordings with restarts, clock steps, wraps and damaged chunks.

Each result is right (that of the whole recording), or reported (a line says what was not used, or the command refuses
with a line); silently wrong is none.
"""

import contextlib
import io
import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from ccatp.cli import main
from ccatp.core import FloatArray
from tests.faults.linking import Measured
from tests.fuzz.recordings import Spoiling, cases, spoil
from tests.support.recorded import record

SEED = 1
COUNT = 120
RIGHT, REPORTED = "right", "reported"


class Answer:
    """What a command printed, and its exit status."""

    def __init__(self, *argv: object) -> None:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            self.status = main([*map(str, argv)])
        self.out, self.err = out.getvalue(), err.getvalue()
        assert "unexpected" not in self.err, f"{argv}: {self.err}"

    @property
    def data(self) -> Any:
        """Its JSON."""
        return json.loads(self.out)

    def says(self, *words: str) -> bool:
        """Whether a line on standard error has one of these words."""
        return any(word in self.err for word in words)


LOSSES = ("damaged or cut off", "frames are missing", "cannot be joined", "not used")


def poses(path: Path) -> FloatArray:
    return np.loadtxt(path, ndmin=2)


def is_part_of(found: FloatArray, every: FloatArray) -> bool:
    """Whether each row, by its time, is one of ``every``; the rows in their order of time."""
    if not len(found) or not (np.diff(found[:, 0]) > 0.0).all():
        return False
    at = np.searchsorted(every[:, 0], found[:, 0] - 1e-3)  # a tenth of a frame
    if at[-1] >= len(every):
        return False
    return bool(np.allclose(found, every[at], rtol=0.0, atol=1e-6))


class Readers:
    """Results of the whole recording, and the checks of those of another one."""

    def __init__(self, run_dir: Path, scratch: Path, names: tuple[str, ...]) -> None:
        self.whole = run_dir
        self.expected = {name: READ[name](run_dir, scratch / "whole") for name in names}

    def check(self, name: str, run_dir: Path, folder: Path) -> str:
        """How a command did; raises AssertionError where it is silently wrong."""
        found, answer = READ[name](run_dir, folder)
        whole, _ = self.expected[name]
        return CHECK[name](found, whole, answer, self)


Found = tuple[Any, Answer]


def read_tum(run_dir: Path, folder: Path) -> Found:
    folder.mkdir(parents=True, exist_ok=True)
    files = folder / "estimate.tum", folder / "truth.tum"
    answer = Answer("recording", "export", run_dir, "--tum", files[0], "--truth", files[1])
    return ([poses(file) for file in files] if answer.status == 0 else None), answer


def check_tum(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    if found is None:
        assert answer.err.count("\n") == 1
        return REPORTED
    for one, every in zip(found, whole, strict=True):
        assert is_part_of(one, every)
        assert len(one) == len(every) or answer.says(*LOSSES)
    return RIGHT if all(map(len_equal, found, whole)) else REPORTED


def len_equal(one: FloatArray, other: FloatArray) -> bool:
    return len(one) == len(other)


def read_bag(run_dir: Path, folder: Path) -> Found:
    bag = folder / "bag"
    answer = Answer("recording", "export", run_dir, "--ros2", bag)
    if answer.status:
        return None, answer
    rows: dict[str, list[tuple[float, ...]]] = {}
    with AnyReader([bag]) as reader:
        for connection, time_ns, data in reader.messages():
            if connection.topic not in COMPARED:
                continue
            message: Any = None if connection.topic == "/joint_states" else reader.deserialize(data, connection.msgtype)
            row: tuple[float, ...] = (float(time_ns),)
            if connection.topic in {"/odom", "/ground_truth/odom"}:
                place = message.pose.pose.position
                row = (*row, place.x, place.y, place.z)
            elif connection.topic == "/imu":
                row = (*row, message.angular_velocity.z, message.linear_acceleration.x)
            rows.setdefault(connection.topic, []).append(row)
    tables = {topic: np.array(found) for topic, found in rows.items()}
    begin_ns = tables["/odom"][0, 0] if "/odom" in tables else 0.0
    for table in tables.values():
        table[:, 0] = 1e-9 * (table[:, 0] - begin_ns)
    return tables, answer


COMPARED = ("/odom", "/ground_truth/odom", "/imu", "/joint_states")


def check_bag(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    if found is None:
        assert answer.err.count("\n") == 1
        return REPORTED
    is_whole = True
    for topic in COMPARED:
        assert topic in found or answer.says(*LOSSES)
        if topic in found:
            one, every = found[topic].copy(), whole[topic]
            # The first frame may be lost: times count from the first one that is there.
            if topic == "/odom":
                assert is_part_of(shifted(one, every), every)
            assert (np.diff(one[:, 0]) > 0.0).all(), topic
            is_whole = is_whole and len(one) == len(every)
            if len(one) == len(every):
                assert np.allclose(one, every, rtol=0.0, atol=1e-6), topic
            else:
                # Samples of before a restart that its first frame would bring are gone with the frame's buffer.
                assert answer.says(*LOSSES, "restarted"), topic
    return RIGHT if is_whole else REPORTED


def shifted(one: FloatArray, every: FloatArray) -> FloatArray:
    """Times as in ``every``, by the first place."""
    first = np.flatnonzero((every[:, 1:] == one[0, 1:]).all(axis=1))
    return one + np.concatenate([[every[first[0], 0]], np.zeros(one.shape[1] - 1)]) if len(first) else one


def read_replay(run_dir: Path, _: Path) -> Found:
    answer = Answer("replay", run_dir, "--json")
    return (answer.data if answer.out else None), answer


def check_replay(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    if found is None:
        assert answer.err.count("\n") >= 1
        return REPORTED
    has_loss = answer.says(*LOSSES)
    assert found["frames"] == whole["frames"] or has_loss
    one, other = found["recorded"], whole["recorded"]
    if not has_loss:
        assert close(one, other), f"{one} {other}"
        assert found["span_s"] == pytest.approx(whole["span_s"], abs=1e-3), "span"
        assert found["fixes"]["given"] == whole["fixes"]["given"], "fixes"
    nees = found["replayed"]["nees_mean"]
    assert nees is None or nees >= 0.0
    # The estimator is given the robot's times: it may make of a step in motion, or of a gap, what the run did not see.
    # Then a line and the status say so.
    if found["difference"]["reproduced"]:
        assert close(found["replayed"], whole["replayed"]) or has_loss, f"{found['replayed']} {whole['replayed']}"
    else:
        assert answer.status or has_loss, "the status says that it is reproduced"
    return RIGHT if found["difference"]["reproduced"] and not has_loss else REPORTED


def close(one: Any, other: Any) -> bool:
    """Equal numbers to a micrometre or a millionth of a radian, in the same structure."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(close(one[key], other[key]) for key in one)
    if isinstance(one, float) and isinstance(other, float | int):
        return bool(np.isclose(one, other, rtol=1e-6, atol=1e-6))
    return bool(one == other)


def read_report(run_dir: Path, folder: Path) -> Found:
    folder.mkdir(parents=True, exist_ok=True)
    answer = Answer("report", run_dir, "--out", folder / "report.html", "--json")
    return (answer.data if answer.out else None), answer


_OF_FILES = frozenset(("report", "run", "warnings", "missing", "time_budget_s", "observation"))


def check_report(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    assert found is not None
    has_loss = answer.says(*LOSSES)
    for key in whole.keys() - _OF_FILES:
        assert close(found.get(key), whole[key]) or has_loss, key
    total_s = found["time_budget_s"]["total"]
    exact = "the frames of each change of state" in str(found["missing"])
    assert total_s == pytest.approx(whole["time_budget_s"]["total"], abs=0.02) or has_loss or exact
    assert total_s < whole["time_budget_s"]["total"] + 1.0
    return RIGHT if not has_loss else REPORTED


def read_calibration(run_dir: Path, _: Path) -> Found:
    answer = Answer("calibrate", "--from", run_dir, "--json")
    return (answer.data if answer.out else None), answer


def check_calibration(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    if found is None:  # too few legs, or no better than a measuring tape
        assert answer.status == 2
        return REPORTED
    assert whole is not None
    for key, one in found["parameters"].items():
        other = whole["parameters"][key]
        assert abs(one["found"] - other["found"]) <= 4.0 * float(np.hypot(one["sigma"], other["sigma"])), key
    assert found["segments"] == whole["segments"] or answer.says(*LOSSES)
    return RIGHT if found["segments"] == whole["segments"] else REPORTED


def read_alignment(run_dir: Path, _: Path) -> Found:
    answer = Answer("align", run_dir, "--json")
    return answer.data, answer


def check_alignment(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    fixed = {key: value for key, value in found.items() if key not in {"run_dir", "warnings", "against_truth"}}
    assert all(close(value, whole[key]) for key, value in fixed.items())
    return RIGHT


def read_comparison(run_dir: Path, folder: Path) -> Found:
    folder.mkdir(parents=True, exist_ok=True)
    answer = Answer("compare", run_dir, run_dir, "--out", folder / "compare.html", "--json")
    return answer.data, answer


def check_comparison(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    has_loss = answer.says(*LOSSES)
    for key in ("figures", "values"):
        if key in whole and not has_loss:
            assert close(found[key], whole[key]) or answer.says("stepped", "restarted")
    return REPORTED if has_loss else RIGHT


def read_facts(run_dir: Path, _: Path) -> Found:
    answer = Answer("recording", "info", run_dir, "--json")
    return answer.data["recordings"][0], answer


def check_facts(found: Any, whole: Any, answer: Answer, _: Readers) -> str:
    assert found["verified"] is (answer.status == 0)
    if found["verified"]:
        assert found["end_s"] - found["start_s"] == pytest.approx(whole["end_s"] - whole["start_s"], abs=0.05)
    return RIGHT if found["verified"] else REPORTED


READ: dict[str, Callable[[Path, Path], Found]] = {
    "export --ros2": read_bag,
    "export --tum": read_tum,
    "replay": read_replay,
    "report": read_report,
    "calibrate": read_calibration,
    "align": read_alignment,
    "compare": read_comparison,
    "info": read_facts,
}
CHECK: dict[str, Callable[[Any, Any, Answer, Readers], str]] = {
    "export --tum": check_tum,
    "export --ros2": check_bag,
    "replay": check_replay,
    "report": check_report,
    "calibrate": check_calibration,
    "align": check_alignment,
    "compare": check_comparison,
    "info": check_facts,
}


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without figures, which take seconds for a page; other tests draw them."""
    for page in ("run_page", "compare"):
        monkeypatch.setattr(f"ccatp.report.{page}.page_figures", lambda drawings: dict.fromkeys(drawings, ("", "")))


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return survey_in(tmp_path_factory.mktemp("whole") / "tonight")


def survey_in(run_dir: Path) -> Path:
    """A calibration drive and a point, then home."""
    settings: dict[str, Any] = {"mission__calibration_length_m": 0.1, "mission__calibration_rounds": 1}
    return record(run_dir, only=1, run__world="thesis", run__filter="ekf", **settings)


def frames_of(run_dir: Path) -> int:
    return len(poses(read_poses(run_dir)))


def read_poses(run_dir: Path) -> Path:
    file = run_dir.parent / "frames.tum"
    Answer("recording", "export", run_dir, "--tum", file)
    return file


def classify(readers: Readers, spoiling: Spoiling, folder: Path, names: tuple[str, ...], wrong: list[str]) -> list[str]:
    """How each command did; what is silently wrong is added to ``wrong``."""
    run_dir = spoil(readers.whole, folder / "run", spoiling)
    found = []
    for name in names:
        try:
            found.append(readers.check(name, run_dir, folder / name.replace(" ", "")))
        except AssertionError as error:
            wrong.append(f"{spoiling.name}: {name}: {error}")
    return found


QUICK = (0, 1, 4, 6)  # a restart, a wrap, a damaged chunk, and a restart with a wrap


@pytest.mark.fault("P25", "P26")
def test_no_reader_is_silently_wrong_about_restarts_steps_and_damage(
    survey: Path, tmp_path: Path, measured: Measured
) -> None:
    names = ("export --tum", "replay", "calibrate", "info")
    readers, every = Readers(survey, tmp_path, names), cases(frames_of(survey), SEED, COUNT)
    found, wrong = list[str](), list[str]()
    for k in QUICK:
        found += classify(readers, every[k], tmp_path / str(k), names, wrong)
    measured("P25", len(wrong))
    measured("P26", len(wrong))
    assert wrong == []
    assert Counter(found)[RIGHT] > len(QUICK)


@pytest.mark.slow
@pytest.mark.fault("P25", "P26")
def test_no_command_is_silently_wrong_in_a_hundred_and_twenty_combinations(
    survey: Path, tmp_path: Path, measured: Measured
) -> None:
    names = tuple(READ)
    readers = Readers(survey, tmp_path, names)
    found, wrong = list[str](), list[str]()
    for k, spoiling in enumerate(cases(frames_of(survey), SEED, COUNT)):
        folder = tmp_path / str(k)
        # A bag takes more time than all others.
        found += classify(readers, spoiling, folder, names if k % 4 == 0 else names[1:], wrong)
        shutil.rmtree(folder)
    print(f"{COUNT} recordings, {len(found)} commands: {dict(Counter(found))}")
    measured("P25", len(wrong))
    measured("P26", len(wrong))
    assert wrong == []
    assert len(found) == COUNT * len(READ) - 3 * COUNT // 4
    assert Counter(found)[RIGHT] > len(found) // 3
