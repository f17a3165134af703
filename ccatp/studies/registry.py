"""THE table of studies: name, module, one line. A study is imported when it is asked for."""

import difflib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from ccatp.config.models import Config
    from ccatp.studies.campaign import Study


# The help of the command reads the table, and shall not wait for what the studies need.


Analysis: TypeAlias = "Callable[[Config, Path], dict[str, Any]]"
"""A study without runs: a configuration and a directory, to what ``result.json`` holds."""


class StudyEntry(NamedTuple):
    """A row: the module, the name in it of a ``Study`` or of an ``Analysis``, one line for the help."""

    module: str
    attribute: str
    title: str


STUDIES = {
    "thesis": StudyEntry(
        "ccatp.studies.thesis_study", "STUDY", "the thesis's own simulation again, under several readings"
    ),
    "filters": StudyEntry("ccatp.studies.filters_study", "STUDY", "filters in four worlds, over whole missions"),
    "time": StudyEntry("ccatp.studies.time_study", "STUDY", "order, speed and measuring time against the hour"),
    "sensitivity": StudyEntry(
        "ccatp.studies.factor_studies", "SENSITIVITY", "what each disturbance of a hard world costs"
    ),
    "ablation": StudyEntry("ccatp.studies.factor_studies", "ABLATION", "what each technique gives, one off at a time"),
    "danger": StudyEntry("ccatp.studies.danger_study", "STUDY", "false edges and overrun of two edge rules"),
    "faults": StudyEntry("ccatp.studies.faults_study", "STUDY", "whole missions with random faults: falls, completion"),
    "cricket": StudyEntry(
        "ccatp.studies.cricket_study", "STUDY", "self-mapping of motes: the published figures, better ways"
    ),
    "mote-sizes": StudyEntry("ccatp.studies.mote_sizes", "run", "time of self-mapping against the number of motes"),
    "mote-navigation": StudyEntry(
        "ccatp.studies.mote_navigation", "STUDY", "a robot guided by motes that mapped themselves"
    ),
    "radio-signals": StudyEntry(
        "ccatp.studies.radio_signals_study", "STUDY", "levels and bearings of ZigBee radios, beside 2017"
    ),
    "radio-slam": StudyEntry(
        "ccatp.studies.radio_studies", "RADIO_SLAM", "EKF-SLAM among ZigBee radios: rooms, slip, shadowing"
    ),
    "radio-cases": StudyEntry(
        "ccatp.studies.radio_studies", "RADIO_CASES", "cases I to III of 2017 side by side with ours"
    ),
    "radio-follow": StudyEntry("ccatp.studies.radio_studies", "RADIO_FOLLOW", "a moving radio followed, beside 2018"),
    "loops": StudyEntry("ccatp.studies.loops", "run", "Bode plots, margins and root loci of the controllers"),
}


def find_study(name: str) -> "Study | Analysis":
    """The study of a name.

    Raises:
        CampaignError: there is none.
    """
    entry = STUDIES.get(name)
    if entry is None:
        from ccatp.studies.campaign import CampaignError  # noqa: PLC0415

        near = difflib.get_close_matches(name, STUDIES, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(STUDIES)}"
        raise CampaignError(f"no study {name!r}; {hint}")
    found: Study | Analysis = getattr(import_module(entry.module), entry.attribute)
    return found
