"""The page of a survey, from its configuration and its run directory."""

from contextlib import suppress
from pathlib import Path

from ccatp.config.models import Config
from ccatp.mirror.mirror import build_mirror
from ccatp.records.store import StoreError, read_survey
from ccatp.report.dashboard.hub import SURVEY, Page
from ccatp.report.dashboard.survey_view import SurveyView, ground


def survey_page(cfg: Config, run_dir: Path, is_sim: bool) -> Page:
    """The page, with the points that are measured already."""
    mirror = build_mirror(cfg.mirror)
    view = SurveyView(mirror, cfg, is_sim=is_sim, run_dir=run_dir)
    with suppress(StoreError):  # nothing has been measured yet
        view.begin_with(read_survey(run_dir / "mission.sqlite", mirror.name))
    return Page(view, SurveyView(mirror, cfg, is_sim=is_sim), ground(mirror, cfg, is_sim=is_sim), SURVEY)
