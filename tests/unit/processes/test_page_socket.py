"""Where the dashboard listens, and what is said when it cannot."""

import socket

import pytest

from ccatp.config.models import Config
from ccatp.daemon import dashboard as page_socket
from ccatp.daemon.dashboard import open_page_socket, page_url


def test_none_is_wanted(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"enabled": False}))
    assert (page.socket, page.text) == (None, "")


def test_any_free_port(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"port": 0}))
    assert page.socket is not None
    with page.socket:
        assert page.config.port == page.socket.getsockname()[1] != 0
        assert (page.level, page.text) == ("info", f"dashboard: http://127.0.0.1:{page.config.port}/")


def test_a_port_in_use_is_replaced_and_told(config: Config) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        page = open_page_socket(config.dashboard.model_copy(update={"port": port}))
        assert page.socket is not None
        with page.socket:
            assert page.config.port != port
            assert page.level == "warning"
            assert page.text == (f"dashboard: port {port} is in use, so it is at http://127.0.0.1:{page.config.port}/")


def test_an_address_that_is_not_ours_is_no_end_of_a_survey(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"host": "192.0.2.1"}))
    assert page.socket is None
    assert page.level == "warning"
    assert page.text.startswith(
        "no dashboard: cannot listen on 192.0.2.1:7080: Cannot assign requested address; choose"
    )


def test_no_port_at_all(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_host: str, _port: int) -> socket.socket:
        raise OSError(98, "Address already in use")

    monkeypatch.setattr(page_socket, "_listen", refuse)
    page = open_page_socket(config.dashboard)
    assert page.socket is None
    assert page.text.startswith("no dashboard: cannot listen on 127.0.0.1:7080: Address already in use")


def test_addresses() -> None:
    assert page_url("127.0.0.1", 7080) == "http://127.0.0.1:7080/"
    assert page_url("::1", 7080) == "http://[::1]:7080/"
