"""Fixtures of the full-state localizer's tests."""

import pytest

from ccatp.config.models import FullStateConfig, LocalizerConfig
from tests.unit.estimation import drive


@pytest.fixture(scope="session")
def cfg() -> LocalizerConfig:
    """[localizer] as shipped."""
    return drive.config().localizer


@pytest.fixture(scope="session")
def full(cfg: LocalizerConfig) -> FullStateConfig:
    """[localizer.full_state] as shipped."""
    return cfg.full_state


@pytest.fixture(params=["ekf", "ukf"])
def filter_name(request: pytest.FixtureRequest) -> str:
    """Each filter that takes the full-state model."""
    return str(request.param)
