"""The compiled build: it computes what the source computes, and its processes talk to each other.

It is built from this tree by the tools of this environment, which takes minutes; a C compiler is needed.
"""

import json
import os
import subprocess
import sys
import zipfile
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.core import FloatArray
from ccatp.filters.conditioning import Conditioner
from ccatp.studies.sil_run import rehearse

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("compiled")]

ROOT = Path(__file__).resolve().parents[2]
STATES = 19
MISSION = {"run.world": "hard", "run.filter": "ekf", "run.panels": 2, "run.seed": 1}
# A mission whose matrix steps are numpy's, or those in C.
PROGRAM = """
import json, sys
if sys.argv[1] == "numpy":
    sys.modules["ccatp.filters._kernel"] = None
from ccatp.config.load import load_config
from ccatp.filters.block_kernel import IS_COMPILED
from ccatp.config.package import build
from ccatp.studies.sil_run import rehearse
summary = rehearse(load_config(None, json.loads(sys.argv[2]))).summary
print(json.dumps({"build": build(), "has_kernel": IS_COMPILED, "summary": summary}))
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


@pytest.fixture(scope="module")
def kernel(site: Path) -> ModuleType:
    """The matrix steps in C."""
    found = [site / f"ccatp/filters/_kernel{suffix}" for suffix in EXTENSION_SUFFIXES]
    path = str(next(path for path in found if path.is_file()))
    spec = spec_from_file_location("_kernel", path, loader=ExtensionFileLoader("_kernel", path))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_the_compiled_source_gives_the_same_mission_to_the_last_bit(site: Path, tmp_path: Path) -> None:
    done = run(site, tmp_path, "-c", PROGRAM, "numpy", json.dumps(MISSION))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["build"], found["has_kernel"]) == ("compiled", False)
    expected = rehearse(load_config(None, MISSION)).summary
    assert found["summary"] == json.loads(json.dumps(expected))


def test_the_mission_with_the_kernel_is_as_good(site: Path, tmp_path: Path) -> None:
    done = run(site, tmp_path, "-c", PROGRAM, "C", json.dumps(MISSION))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["has_kernel"]
    summary, expected = found["summary"], rehearse(load_config(None, MISSION)).summary
    assert summary["points"] == expected["points"]
    assert summary["localization_error_mm"]["within_10mm_fraction"] == 1.0
    # Rounding moves a decision by a frame, and from then on other noise is drawn.
    assert summary["mission_time_s"] == pytest.approx(expected["mission_time_s"], rel=0.02)


def test_its_processes_run_a_survey_in_lockstep(site: Path, tmp_path: Path) -> None:
    assert run(site, tmp_path, "-m", "ccatp", "--version").stdout.endswith(" compiled\n")
    options = ["--sim", "--json", "--panels", "1", "--set", "run.filter=ekf", "--run-dir", str(tmp_path / "run")]
    done = run(site, tmp_path, "-m", "ccatp", "run", *options, "--runtime-dir", str(tmp_path / "rt"))
    assert done.returncode == 0, done.stderr
    points = json.loads(done.stdout)["points"]
    assert points["measured"] == points["total"] == 9


def problem(
    rng: np.random.Generator, rows: int, strength: float = 1.0
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """P (n, n), nu (m,), H (m, n), R (m,) of states of all magnitudes; variance of a row over its noise."""
    sizes = 10.0 ** rng.uniform(-5.0, 1.0, STATES)
    root = rng.standard_normal((STATES, STATES)) * sizes[:, None]
    half = root.dot(root.T)
    H = rng.standard_normal((rows, STATES)) * (rng.random((rows, STATES)) < 0.3) / sizes
    own = np.maximum(np.einsum("ij,jk,ik->i", H, half, H), 1.0)
    R = rng.uniform(0.3, 3.0, rows) * own / strength
    return 0.5 * (half + half.T), rng.standard_normal(rows) * np.sqrt(own), H, R


@pytest.mark.parametrize("seed", range(20))
def test_the_kernel_is_numpy_to_rounding(kernel: ModuleType, seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, nu, H, R = problem(rng, 1 + seed % 12)
    F = np.eye(STATES) + rng.standard_normal((STATES, STATES)) * (rng.random((STATES, STATES)) < 0.1)
    G, variances, drift = rng.standard_normal((STATES, 5)), rng.random(5), rng.random(STATES)
    Q = kernel.spread(G, variances, drift)
    np.testing.assert_allclose(Q, (G * variances).dot(G.T) + np.diag(drift), rtol=1e-12, atol=1e-13)
    ahead = kernel.advance(P, F, Q)
    scale = np.sqrt(np.outer(ahead.diagonal(), ahead.diagonal()))
    np.testing.assert_allclose(ahead / scale, (F.dot(P).dot(F.T) + Q) / scale, rtol=0.0, atol=1e-12)
    change, covariance, nis = kernel.condition(P, nu, H, R)
    expected = Conditioner(STATES).on_rows(P, nu, H, R)
    sigma = np.sqrt(P.diagonal())
    np.testing.assert_allclose(change / sigma, expected.change / sigma, rtol=1e-12, atol=1e-12)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(covariance / scale, expected.covariance / scale, rtol=0.0, atol=1e-12)
    assert nis == pytest.approx(expected.nis, rel=1e-12)
    for symmetric in (Q, ahead, covariance):
        assert np.array_equal(symmetric, symmetric.T)


@pytest.mark.parametrize("seed", range(12))
def test_the_kernel_keeps_the_digits_of_strong_rows(kernel: ModuleType, seed: int) -> None:
    P, nu, H, R = problem(np.random.default_rng(seed), 1 + seed % 4, strength=1e7)
    change, covariance, nis = kernel.condition(P, nu, H, R)
    expected = Conditioner(STATES).on_rows(P, nu, H, R)
    # Of the posterior: what is left of some of its states is a ten-millionth of the prior.
    sigma = np.sqrt(expected.covariance.diagonal())
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(covariance / scale, expected.covariance / scale, rtol=0.0, atol=1e-10)
    size = np.abs(expected.change / np.sqrt(P.diagonal())).max()
    np.testing.assert_allclose(
        change / np.sqrt(P.diagonal()) / size, expected.change / np.sqrt(P.diagonal()) / size, atol=1e-12
    )
    assert nis == pytest.approx(expected.nis, rel=1e-10)
    assert np.array_equal(covariance, covariance.T)


def test_what_is_out_of_the_ordinary_is_left_to_numpy(kernel: ModuleType) -> None:
    P, nu, H, R = problem(np.random.default_rng(1), 3)
    assert kernel.condition(P, nu, H, R) is not None
    assert kernel.condition(P, nu, H, np.diag(R)) is None  # correlated noise
    assert kernel.condition(P, nu, H, -R) is None
    assert kernel.condition(P, nu * np.nan, H, R) is None
    assert kernel.condition(P * np.inf, nu, H, R) is None
    assert kernel.condition(P.astype(np.float32), nu, H, R) is None
    assert kernel.condition(P[::-1], nu, H, R) is None
    assert kernel.condition(P, nu[:2], H, R) is None
    prior = H[0].dot(P).dot(H[0])
    exact = np.array([0.5e-8 * prior, *R[1:]])
    assert kernel.condition(P, nu, H, exact) is None  # too strong to keep its digits
    twice = np.array([H[0], H[0]])
    assert kernel.condition(P, nu[:2], twice, np.full(2, 2e-6 * prior)) is None  # the second repeats the first
    assert kernel.advance(P, np.eye(STATES) * np.nan, P) is None
    assert kernel.advance(P, np.eye(STATES)[:3], P) is None
    assert kernel.spread(P[:, ::2], R, R) is None
    assert kernel.spread(P, R, nu) is None
    with pytest.raises(TypeError, match="condition takes P, nu, H and R"):
        kernel.condition(P)
    with pytest.raises(TypeError, match="advance takes P, F and Q"):
        kernel.advance(P)
    with pytest.raises(TypeError, match="spread takes G, variances and drift"):
        kernel.spread(P)


def test_a_machine_without_a_compiler_is_told(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "packaging/compiled/build.py"), str(ROOT), str(tmp_path)]
    done = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("ccatp: the compiled build cannot be made: no C compiler (")
    assert done.stderr.count("\n") == 1
