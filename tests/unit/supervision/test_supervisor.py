"""What can be wrong before a run begins, and the process table."""

import socket
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest

from ccatp.config.load import dump_config, load_config
from ccatp.daemon.run_dir import RunOptions, own_runtime_dir, owned, survey_run_dir
from ccatp.daemon.supervisor import PROCESSES, _recover, run_survey
from ccatp.errors import ConfigError, RefusedError
from ccatp.links.runtime_dir import is_deserted


def options(**fields: object) -> RunOptions:
    return RunOptions(sim=True, **fields)  # type: ignore[arg-type]


def test_the_table_names_real_modules_and_main_stops_first() -> None:
    assert [p.name for p in PROCESSES] == ["dashboard", "dataloop", "etalon", "danger", "main"]
    assert all(find_spec(p.module) is not None for p in PROCESSES)
    assert PROCESSES[-1].name == "main"  # stopping is in the reverse order


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        wanted = options(overrides={"sim.robot.port": port}, runtime_dir=tmp_path / "rt", run_dir=tmp_path / "run")
        with pytest.raises(ConfigError, match=rf"sim\.robot\.port: cannot listen on 127\.0\.0\.1:{port}: .*--set"):
            run_survey(wanted)
    assert not (tmp_path / "run").exists()


def test_a_run_directory_with_a_mission_wants_resume(tmp_path: Path) -> None:
    (tmp_path / "mission.sqlite").touch()
    with pytest.raises(ConfigError, match="holds a mission already; give --resume"):
        survey_run_dir(options(run_dir=tmp_path), load_config())
    assert survey_run_dir(options(run_dir=tmp_path, resume=True), load_config()) == tmp_path


def test_nothing_to_resume(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no mission in"):
        survey_run_dir(options(run_dir=tmp_path, resume=True), load_config())


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"run.panels": 2}, "run.panels was 1 in .* and is 2 now"),
        ({"run.panels": 1, "run.order": "optimised"}, "run.order was thesis in .* and is optimised now"),
        ({"run.panels": 1, "run.mirror": "thesis-m2"}, "run.mirror was fyst-m1 in .* and is thesis-m2 now"),
    ],
)
def test_a_survey_is_resumed_with_its_own_points(tmp_path: Path, changes: dict[str, object], told: str) -> None:
    (tmp_path / "mission.sqlite").touch()
    before = dump_config(load_config(overrides={"run.panels": 1}))
    (tmp_path / "config.toml").write_text(before)
    with pytest.raises(ConfigError, match=told):
        survey_run_dir(options(run_dir=tmp_path, resume=True), load_config(overrides=changes))
    assert (tmp_path / "config.toml").read_text() == before
    same = load_config(overrides={"run.panels": 1})
    assert survey_run_dir(options(run_dir=tmp_path, resume=True), same) == tmp_path


def test_a_run_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot make"):
        survey_run_dir(options(run_dir=tmp_path / "file" / "run"), load_config())


def test_one_daemon_in_a_runtime_directory(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with owned(path, "--runtime-dir"), pytest.raises(RefusedError, match="another ccatp runs in"):  # noqa: SIM117
        with owned(path, "--runtime-dir"):
            pass
    with owned(path, "--runtime-dir"):
        pass


def test_the_sockets_go_with_the_daemon(tmp_path: Path) -> None:
    for is_sim, left in ((False, {"puck", "main2", "truth"}), (True, {"main2"})):
        with ExitStack() as stack:
            own_runtime_dir(stack, tmp_path, is_sim=is_sim)
            for name in ("control", "puck", "truth", "main2"):
                with socket.socket(socket.AF_UNIX) as made:
                    (tmp_path / name).unlink(missing_ok=True)
                    made.bind(str(tmp_path / name))
            (tmp_path / "main").write_text("no socket")
            assert not is_deserted(tmp_path)
        assert {path.name for path in tmp_path.iterdir() if path.is_socket()} == left
        assert is_deserted(tmp_path)
        assert (tmp_path / "main").read_text() == "no socket"


def test_a_list_of_clients_that_cannot_be_used_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    keys = {"key_file": str(tmp_path / "k"), "clients_file": str(tmp_path / "none.toml")}
    observatory = {f"observatory.{name}": value for name, value in keys.items()}
    wanted = options(
        overrides={"observatory.endpoint": "tcp://127.0.0.1:0", **observatory},
        runtime_dir=tmp_path / "rt",
        run_dir=tmp_path / "run",
    )
    with pytest.raises(ConfigError, match=r"observatory\.clients_file: cannot read .*none\.toml: No such file"):
        run_survey(wanted)
    assert list(tmp_path.iterdir()) == []


def test_a_service_goes_on_with_the_run_that_did_not_finish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RunOptions] = []

    def run(wanted: RunOptions) -> int:
        asked.append(wanted)
        assert wanted.run_dir is not None
        wanted.run_dir.mkdir(parents=True, exist_ok=True)
        (wanted.run_dir / "mission.sqlite").touch()
        return 4 if len(asked) == 1 else 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ccatp.daemon.supervisor.run_survey", run)
    assert [_recover(options(recover=True)) for _ in range(2)] == [4, 0]
    first, second = asked
    assert (first.resume, first.held) == (False, False)
    assert (second.resume, second.held, second.run_dir) == (True, True, first.run_dir)
    assert _recover(options(recover=True)) == 0
    assert not asked[2].resume  # the second one finished
