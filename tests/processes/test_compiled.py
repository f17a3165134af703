"""The compiled build: it computes what the source computes, and its processes talk to each other.

It is built from this tree by the tools of this environment, which takes minutes; a C compiler is needed.
"""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ccatp.config.load import load_config
from ccatp.studies.sil_run import rehearse

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("compiled")]

ROOT = Path(__file__).resolve().parents[2]
MISSION = {"run.world": "hard", "run.filter": "ekf", "run.panels": 2, "run.seed": 1}
PROGRAM = """
import json, sys
from ccatp.config.load import load_config
from ccatp.config.package import build
from ccatp.studies.sil_run import rehearse
summary = rehearse(load_config(None, json.loads(sys.argv[1]))).summary
print(json.dumps({"build": build(), "summary": summary}))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the compiled package."""
    wheels, site = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    command = [sys.executable, str(ROOT / "packaging/compiled/build.py"), str(ROOT), str(wheels)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]
    with zipfile.ZipFile(next(wheels.glob("*.whl"))) as wheel:
        wheel.extractall(site)
    return site


def run(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_the_compiled_source_gives_the_same_mission_to_the_last_bit(site: Path, tmp_path: Path) -> None:
    done = run(site, tmp_path, "-c", PROGRAM, json.dumps(MISSION))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["build"] == "compiled"
    expected = rehearse(load_config(None, MISSION)).summary
    assert found["summary"] == json.loads(json.dumps(expected))


def test_its_processes_run_a_survey_in_lockstep(site: Path, tmp_path: Path) -> None:
    assert run(site, tmp_path, "-m", "ccatp", "--version").stdout.endswith(" compiled\n")
    options = ["--sim", "--json", "--panels", "1", "--set", "run.filter=ekf", "--run-dir", str(tmp_path / "run")]
    done = run(site, tmp_path, "-m", "ccatp", "run", *options, "--runtime-dir", str(tmp_path / "rt"))
    assert done.returncode == 0, done.stderr
    points = json.loads(done.stdout)["points"]
    assert points["measured"] == points["total"] == 9


def test_a_machine_without_a_compiler_is_told(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "packaging/compiled/build.py"), str(ROOT), str(tmp_path)]
    done = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("ccatp: the compiled build cannot be made: no C compiler (")
    assert done.stderr.count("\n") == 1
