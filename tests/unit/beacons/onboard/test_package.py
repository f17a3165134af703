"""The small package of the robot among beacons: installed, and started in an environment with nothing else."""

import os
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[4]
PROJECT = ROOT / "packaging" / "beacon_onboard"
LEFT_OUT = ("scipy", "matplotlib", "starlette", "uvicorn", "zmq", "jinja2", "openpyxl", "mcap", "rich", "smbus2")
IMPORT_ALL = """
import importlib, pkgutil, sys
import ccatp
for module in pkgutil.walk_packages(ccatp.__path__, "ccatp."):
    importlib.import_module(module.name)
print(ccatp.__file__)
print(*sorted(name for name in sys.modules if name.startswith("ccatp.")))
"""
START = "import sys; from ccatp.cli.onboard import main; sys.exit(main())"


def needed(requirements: list[str]) -> set[str]:
    """Distributions that these need, and those that they need, as pip would install them."""
    found: set[str] = set()
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        requirement = waiting.pop()
        if requirement.name in found or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        try:
            more = distribution(requirement.name).requires or []
        except PackageNotFoundError:
            continue  # the test of what is imported would show it
        found.add(requirement.name)
        waiting += [Requirement(text) for text in more]
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages with the installed wheel, and what its dependencies need."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-input"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*pip, "wheel", *options, str(PROJECT)], check=True, timeout=120)
    (wheel,) = folder.glob("ccatp_beacon_onboard-*.whl")
    bare = folder / "site"
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", str(bare), str(wheel)], check=True)
    for name in needed(tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["dependencies"]):
        installed = distribution(name)
        for top in {file.parts[0] for file in installed.files or () if file.parts[0] not in {"..", "__pycache__"}}:
            if not (bare / top).exists():
                (bare / top).symlink_to(Path(str(installed.locate_file(top))))
    return bare


def run(site: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python without the packages of this environment: those of the folder alone."""
    command = [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.insert(0, {str(site)!r})\n{code}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=site)


def test_every_module_can_be_imported_with_the_dependencies_alone(site: Path) -> None:
    done = run(site, IMPORT_ALL)
    assert done.returncode == 0, done.stderr
    place, modules = done.stdout.splitlines()
    assert Path(place).is_relative_to(site)
    names = set(modules.split())
    assert {"ccatp.beacons.onboard.kind", "ccatp.onboard.program"} <= names
    parts = {name.split(".")[2] for name in names if name.startswith("ccatp.beacons.") and name.count(".") >= 2}
    assert not parts & {"cricket", "estimation", "filters", "datasets", "sim", "daemon"}
    for name in LEFT_OUT:
        assert run(site, f"import {name}").returncode == 1


def test_the_installed_command_is_there(site: Path) -> None:
    text = (site / "bin" / "ccatp-onboard").read_text()
    assert "from ccatp.cli.onboard import main" in text
    assert os.access(site / "bin" / "ccatp-onboard", os.X_OK)


# What the configuration says, the status that the program ends with, and what it says last.
MISSING = [
    ('devices.base.device = "/dev/nowhere"', 5, "ccatp: base: /dev/nowhere: is not there; check the wiring"),
    ('devices.base.device = "/dev/null"', 5, "ccatp: base: /dev/null: "),  # no serial port
    ("devices.base.is_used = false\ndevices.radio.device = '/dev/nowhere'", 5,
     "ccatp: radio: /dev/nowhere: is not there; check the wiring"),
    ("devices.dish.positions = 7", 2, "devices.dish.positions must divide steps_per_turn = 200"),
    ("devices.radio.bauds = 9600", 2, "devices.radio.bauds"),
    ("devices.radio.is_used = false", 2, "devices.dish.is_used needs devices.radio"),
    ("devices.base.is_used = false\ndevices.radio.is_used = false\ndevices.dish.is_used = false", 2,
     "devices.base.is_used is false, as of all other devices"),
    ("devices.base.sonars = [1, 1, 2, 3, 4, 5, 6, 7]", 2, "devices.base.sonars names a sonar twice"),
    (f"devices.radio.names = {[f'b{k}' for k in range(21)]}", 2,
     "devices.radio.names times devices.dish.positions exceeds 800 levels"),
    ("devices.base.baud = 4800", 2, "devices.base.baud"),
    ("devices.listeners.is_used = true", 2, "devices.base.baud lets packets take 0.06 s"),
    ("devices.radio.api_mode = 0", 2, "devices.radio.api_mode"),
    ("devices.base.most_watchdog_s = 0.01", 2, "devices.base.most_watchdog_s stops a loop"),
]  # fmt: skip
# Imported once: each configuration is started in a fork of the process, which sees nothing of the others.
START_EACH = """
import os, sys
import ccatp.beacons.onboard.kind, ccatp.onboard.program
from ccatp.cli.onboard import main
for config in sys.argv[1:]:
    if not (child := os.fork()):
        sys.argv[1:] = ["--config", config]
        os.dup2(os.open(config + ".err", os.O_WRONLY | os.O_CREAT), 2)
        sys.exit(main())
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def started(site: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str]]:
    """Status and standard error of the program for each row of ``MISSING``."""
    folder = tmp_path_factory.mktemp("missing")
    configs = [folder / f"{number}.toml" for number in range(len(MISSING))]
    for config, (settings, *_) in zip(configs, MISSING, strict=True):
        config.write_text('kind = "beacons"\nlink.port = 0\nlink.host = "127.0.0.1"\n' + settings + "\n")
    done = run(site, START_EACH, *map(str, configs))
    assert done.returncode == 0, done.stderr
    statuses = [int(line) for line in done.stdout.split()]
    return [(status, Path(f"{config}.err").read_text()) for status, config in zip(statuses, configs, strict=True)]


@pytest.mark.parametrize("number", range(len(MISSING)), ids=[message for *_, message in MISSING])
def test_started_bare_it_names_what_is_missing(started: list[tuple[int, str]], number: int) -> None:
    (status, error), (_, expected, message) = started[number], MISSING[number]
    assert status == expected, error
    assert message in error.splitlines()[-1]
    assert "Traceback" not in error


def test_the_kind_of_another_robot_is_not_installed(site: Path, tmp_path: Path) -> None:
    done = run(site, START, "--check")
    assert done.returncode == 2
    assert 'kind = "mirror": ccatp.onboard.kind is not installed; install the package of this robot' in done.stderr
