"""Figures of studies are drawn small; what PNG and PDF look like is tested where they are written."""

from pathlib import Path
from typing import Any

import pytest

from ccatp.report.plots import save_figure


@pytest.fixture(autouse=True)
def small_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    def save(figure: Any, path: Path) -> None:
        if path.suffix == ".png":
            save_figure(figure, path, dpi=20.0)
        else:
            path.touch()

    monkeypatch.setattr("ccatp.studies.results.save_figure", save)
