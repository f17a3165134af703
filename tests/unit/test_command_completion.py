"""Tests of completion: the scripts of all three shells, and what a real shell offers with them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.config.package import child_environment


@pytest.mark.parametrize(
    ("shell", "sign"),
    [("bash", "complete -o nosort -F"), ("zsh", "#compdef ccatp"), ("fish", "complete --no-files --command ccatp")],
)
def test_each_shell_gets_its_script(shell: str, sign: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert sign in script
    assert "_CCATP_COMPLETE" in script


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bahs"]) == 2
    assert "did you mean bash?" in capsys.readouterr().err


def test_without_a_bash_its_script_is_there_all_the_same(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ccatp.cli.config.shutil.which", lambda _: None)
    assert main(["completion", "bash"]) == 0
    assert "_ccatp_completion" in capsys.readouterr().out


@pytest.fixture(scope="module")
def bash(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict[str, str]]:
    """A bash, and an environment in which ``ccatp`` is this package."""
    shell = shutil.which("bash")
    if shell is None:
        pytest.skip("no bash here")
    folder = tmp_path_factory.mktemp("bin")
    program = folder / "ccatp"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ccatp "$@"\n')
    program.chmod(0o755)
    environment = child_environment(os.environ)
    return shell, {**environment, "PATH": f"{folder}:{environment['PATH']}"}


# Each TAB is one start of the program: as few as show that every kind of word is completed.
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("ccatp", "re"), ("replay", "resume")),
        (("ccatp", "run", "--mir"), ("--mirror",)),
        (("ccatp", "run", "--mirror", "fyst"), ("fyst-m1", "fyst-m2")),
        (("ccatp", "emergency", "f"), ("fire",)),
    ],
    ids=" ".join,
)
def test_bash_completes(words: tuple[str, ...], offered: tuple[str, ...], bash: tuple[str, dict[str, str]]) -> None:
    shell, environment = bash
    quoted = " ".join(f"'{word}'" for word in words)
    script = f"""
eval "$(ccatp completion bash)"
COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}
_ccatp_completion ccatp
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(
        [shell, "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert set(offered) <= set(done.stdout.split())
    assert all(word.startswith(words[-1]) for word in done.stdout.split())


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_script_is_sound(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell} here")
    assert main(["completion", shell]) == 0
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out)
    subprocess.run([program, "-n", str(script)], check=True, timeout=20)
