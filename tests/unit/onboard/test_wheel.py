"""The small package for the robot's computer: what is in it, and what it does alone."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
LEFT_OUT = ("scipy", "matplotlib", "starlette", "uvicorn", "zmq", "jinja2", "openpyxl", "mcap", "prometheus_client")
IMPORT_ALL = f"""
import importlib, pkgutil, sys
import ccatp
for module in pkgutil.walk_packages(ccatp.__path__, "ccatp."):
    importlib.import_module(module.name)
print(ccatp.__file__)
print(*sorted(set({LEFT_OUT!r}) & set(sys.modules)))
print(*sorted({{name.partition('.')[0] for name in sys.modules}} - set(sys.stdlib_module_names)))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the package is unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-input", "wheel"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*pip, *options, str(ROOT / "packaging" / "onboard")], check=True, timeout=120)
    (wheel,) = folder.glob("ccatp_onboard-*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "unpacked")
    return folder / "unpacked"


def run(package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(package)}
    return subprocess.run(
        [sys.executable, *arguments],
        env=environment,
        cwd=package,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_every_module_of_the_package_can_be_imported_and_none_needs_the_big_packages(package: Path) -> None:
    done = run(package, "-c", IMPORT_ALL)
    assert done.returncode == 0, done.stderr
    place, left_out, third_party = done.stdout.split("\n")[:3]
    assert Path(place).is_relative_to(package)
    assert left_out == ""
    # All that it imports is among its dependencies, or comes with one of them.
    project = tomllib.loads((ROOT / "packaging" / "onboard" / "pyproject.toml").read_text())["project"]
    named = {text.partition(">")[0].replace("-", "_") for text in project["dependencies"]}
    assert {"numpy", "pydantic", "structlog", "click", "msgspec"} <= named & set(third_party.split())


def test_the_command_of_the_package_says_what_is_missing(package: Path) -> None:
    start = "import sys; from ccatp.cli.onboard import main; sys.exit(main())"
    done = run(package, "-c", start, "--set", "devices.motors.gpio_chip=/nowhere", "--port", "0", "--host", "127.0.0.1")
    assert done.returncode == 5
    assert done.stderr.splitlines()[-1].startswith("ccatp: ")
    assert "Traceback" not in done.stderr
    assert run(package, "-c", start, "--help").stdout.startswith("Usage: ")
