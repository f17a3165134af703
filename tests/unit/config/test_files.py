"""What a user can name or write: no pipe, no device, nothing without end; one short line, wherever it is read."""

import gzip
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from ccatp.beacons.datasets.tables import LONGEST_ROW, MOST_DATA_BYTES
from ccatp.config.files import MOST_BYTES, keep_traceback, read_text
from ccatp.config.load import load_config
from ccatp.config.messages import parse_toml
from ccatp.config.package import child_environment
from ccatp.errors import LONGEST_LINE, CcatpError, ConfigError, one_line
from tests.support.command import refused

READERS: dict[str, tuple[str, ...]] = {
    "configuration": ("config", "check", "{file}"),
    "configuration of a run": ("run", "--sim", "--config", "{file}"),
    "mirror": ("plan", "--mirror", "{file}.toml"),
    "faults": ("run", "--sim", "--faults", "{file}"),
    "key of the link": ("run", "--sim", "--set", "robot.key_file={file}"),
    "token": ("run", "--sim", "--set", "dashboard.token_file={file}"),
    "key of a daemon": (
        "emergency",
        "fire",
        "--endpoint",
        "tcp://[::1]:1",
        "--server-key",
        "{file}",
        "--key",
        "{file}",
    ),
    "data": ("radio", "slam", "{file}"),
    "table": ("radio", "calibrate", "{file}"),
    "workbook": ("radio", "calibrate", "{file}.xlsx"),
    "MATLAB file": ("radio", "slam", "{file}.mat"),
    "ranges": ("radio", "map", "--ranges", "{file}"),
}


def pipe(file: Path) -> None:
    os.mkfifo(file)


def device(file: Path) -> None:
    file.symlink_to("/dev/zero")


def endless(file: Path) -> None:
    with file.open("wb") as sparse:
        sparse.truncate(1 << 40)


@pytest.mark.parametrize("make", [pipe, device, endless])
@pytest.mark.parametrize("reader", READERS)
def test_only_files_of_bounded_length_are_read(
    reader: str, make: Callable[[Path], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path / "f")
    for suffix in (".toml", ".xlsx", ".mat"):
        (tmp_path / f"f{suffix}").symlink_to(tmp_path / "f")
    line = refused(capsys, *(word.format(file=tmp_path / "f") for word in READERS[reader]))
    assert ("is no regular file" in line) == (make is not endless), line
    assert len(line) <= LONGEST_LINE + len("ccatp: ")


LONG = "a" * (MOST_BYTES - 100)
CONTENTS = {
    "long value": (f'run.mirror = "{LONG}"', "is no mirror"),
    "long host": (f'robot.host = "{LONG}"', "must"),
    "long key": (f"{LONG} = 1", "is unknown"),
    "long file": (f"# {LONG}\n" * 2, f"is longer than {MOST_BYTES} bytes; shorten it"),
    "many keys": ("".join(f"k{i} = 1\n" for i in range(9000)), "is unknown"),
    "many parts": (".".join("a" * 20_000) + " = 1", "more than 32 parts"),
    "many quoted parts": ("x.y = 1\n[" + ".".join(["'a'"] * 20_000) + "]", ":2: a key has more than 32 parts"),
    "deep": ("x = " + "[" * 50_000, "is not TOML"),
    "host with a line feed": (r'robot.host = "a b\n"', "must be the name or the address of a host"),
    "label of a host": (f'robot.host = "{"a" * 64}.b"', "must be the name or the address of a host"),
    "no host": ('robot.host = ""', "must be the name or the address of a host"),
    "no port": ("robot.port = 0", "must be greater than or equal to 1"),
    "seed of 64 bits": ("run.seed = 9223372036854775808", "must be less than 9223372036854775808"),
    "control characters": (r'robot.key_file = "\u001b[31m\u009b2J"', "must not contain control characters"),
    "zero byte": (r'run.mirror = "a\u0000.toml"', "no file can have that name"),
    "terminal": (r'run.mirror = "\u009b2J\u202e"', r"\x9b2J\u202e"),
}


@pytest.mark.parametrize("content", CONTENTS)
def test_contents_of_a_configuration(content: str, tmp_path: Path) -> None:
    text, expected = CONTENTS[content]
    (tmp_path / "user.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"^") as caught:
        load_config(tmp_path / "user.toml")
    assert expected in str(caught.value)
    assert len(caught.value.problems) <= 11
    assert max(map(len, caught.value.problems)) <= LONGEST_LINE
    assert all(problem.isprintable() for problem in caught.value.problems)


def test_a_text_that_is_parsed_again_is_a_tree_of_its_own() -> None:
    text, tree = "[[a]]\nb = [1, {c = 2}]\n", {"a": [{"b": [1, {"c": 2}]}]}
    changed = parse_toml(text, "file")
    changed["a"][0]["b"][1]["c"] = 3
    changed["a"][0]["b"].append(4)
    changed["a"].append({})
    changed["d"] = 5
    assert parse_toml(text, "file") == tree


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "user.toml"
    file.write_bytes(b"\xef\xbb\xbf[run]\r\nseed = 3\r\n")
    assert load_config(file).run.seed == 3
    assert read_text(file).startswith("[run]")
    file.write_bytes(b"\xef\xbb\xbfseed = 3")
    assert f"{file}:1: seed is unknown" in refused(capsys, "config", "check", file)


def test_data_are_bounded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "wide.csv"
    file.write_text(",".join("c" * LONGEST_ROW))
    assert f"{file}:1: has {2 * LONGEST_ROW - 1} characters" in refused(capsys, "radio", "calibrate", file)
    with gzip.open(file, "wb", 1) as packed:
        for _ in range(1 + MOST_DATA_BYTES // 1_000_000):
            packed.write(bytes(1_000_000))
    assert f"holds more than {MOST_DATA_BYTES} bytes" in refused(capsys, "radio", "slam", file)
    book = tmp_path / "bomb.xlsx"
    with zipfile.ZipFile(book, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in range(3):
            archive.writestr(f"{part}.xml", bytes(2_000_000))
    assert "holds more than 5000000 bytes" in refused(capsys, "radio", "calibrate", book)


def test_messages_are_short_and_printable() -> None:
    line = one_line("begin\n\x1b[31m\udcff " + "x" * 10_000_000 + " end")
    assert line.startswith(r"begin \x1b[31m\udcff x")
    assert line.endswith("x end")
    assert len(line) <= LONGEST_LINE
    assert str(CcatpError("a\x1b")) == r"a\x1b"


def test_a_traceback_goes_into_a_file(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "gone"):
        try:
            raise KeyError("what")
        except KeyError as error:
            line = keep_traceback(error, folder)
        file = Path(line.split()[-1])
        assert line == f"unexpected KeyError: 'what'; its traceback is in {file}"
        assert "raise KeyError" in file.read_text()
        file.unlink()


SHELL = {  # status, and standard error
    '"$@" --help >/dev/full': (2, "ccatp: output cannot be written: No space left on device\n"),
    '"$@" completion zsh >/dev/full': (2, "ccatp: output cannot be written: No space left on device\n"),
    '"$@" --help >&-': (0, ""),
    '"$@" x 2>&-': (2, ""),
    '"$@" x 2>/dev/full': (2, ""),
    '"$@" 2>/dev/full': (2, ""),
    'LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 "$@" report ö': (
        2,
        r"ccatp: \udcc3\udcb6: no such directory; name the directory of a run" + "\n",
    ),
}


@pytest.mark.parametrize("line", SHELL)
def test_streams_that_take_nothing(line: str) -> None:
    ran = subprocess.run(
        ["sh", "-c", line, "sh", sys.executable, "-m", "ccatp"],
        capture_output=True, text=True, check=False, env=child_environment(os.environ),
    )  # fmt: skip
    assert (ran.returncode, ran.stderr) == SHELL[line]
