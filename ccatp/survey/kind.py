"""The survey of a mirror as a kind of mission."""

from ccatp.missions import SURVEY as NAME
from ccatp.missions import MissionKind, Part

SURVEY = MissionKind(
    systems=(NAME,),
    title="survey of a mirror",
    subject="mirror",
    no_faults=None,
    load=Part("ccatp.config.load:load_config"),
    shipped=Part("ccatp.config.describe:shipped_config"),
    text=Part("ccatp.daemon.supervision.survey_run:survey_text"),
    check=Part("ccatp.daemon.supervision.survey_run:check_survey"),
    without_effect=Part("ccatp.config.describe:keys_without_effect"),
    resumed=Part("ccatp.daemon.supervision.survey_run:check_resumed"),
    processes=Part("ccatp.daemon.supervision.supervisor:PROCESSES"),
    record=Part("ccatp.daemon.supervision.survey_record:SurveyRecord"),
    runner=Part("ccatp.daemon.loops.survey_runner:open_survey"),
    limits=Part("ccatp.daemon.supervision.survey_run:loop_limits"),
    rules=Part("ccatp.danger:survey_rules"),
    stand_in=Part("ccatp.dataloop:survey_stand_in"),
    page=Part("ccatp.report.dashboard.survey_page:survey_page"),
    report=Part("ccatp.report.run_page:survey_report"),
    analysis=Part("ccatp.analysis.survey:open_survey"),
)
