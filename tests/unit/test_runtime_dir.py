"""The folder of the sockets."""

import os
from pathlib import Path

import pytest

from ccatp.errors import RuntimeDirError
from ccatp.links.runtime_dir import MAX_SOCKET_NAME_BYTES, MAX_SOCKET_PATH_BYTES, make_runtime_dir, runtime_dir_path


def test_the_configured_folder_comes_first() -> None:
    environ = {"CCATP_RUNTIME_DIR": "/b", "XDG_RUNTIME_DIR": "/c"}
    assert runtime_dir_path("/a", environ) == Path("/a")
    assert runtime_dir_path("", environ) == Path("/b")
    assert runtime_dir_path("", {"XDG_RUNTIME_DIR": "/c"}) == Path("/c/ccatp")
    assert runtime_dir_path("", {}).name == f"ccatp-{os.getuid()}"


def test_the_folder_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    path = make_runtime_dir("", {"XDG_RUNTIME_DIR": str(tmp_path)})
    assert path == tmp_path / "ccatp"
    assert path.stat().st_mode & 0o777 == 0o700
    assert make_runtime_dir(str(path), {}) == path  # a second time


def test_a_path_just_short_enough_for_a_socket_is_taken() -> None:
    longest = MAX_SOCKET_PATH_BYTES - MAX_SOCKET_NAME_BYTES - 1
    path = "/" + "x" * (longest - 1)
    assert runtime_dir_path(path, {}) == Path(path)
    with pytest.raises(RuntimeDirError, match="108 bytes with a socket's name, a unix socket takes at most 107"):
        runtime_dir_path(path + "x", {})


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RuntimeDirError, match="File exists; choose another with --runtime-dir"):
        make_runtime_dir(str(tmp_path / "file"), {})


def test_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(RuntimeDirError, match="is a link, not a folder"):
        make_runtime_dir(str(tmp_path / "link"), {})


@pytest.mark.parametrize("mode", [0o777, 0o720, 0o702])
def test_a_folder_that_others_may_write_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "open"
    path.mkdir()
    path.chmod(mode)
    with pytest.raises(RuntimeDirError, match=rf"others may write there \(mode {mode:04o}\); chmod 700"):
        make_runtime_dir(str(path), {})


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(RuntimeDirError, match=f"belongs to user {owner}, not to {owner + 1}"):
        make_runtime_dir(str(tmp_path), {})
