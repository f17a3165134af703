"""Monte Carlo campaigns, comparisons with published results and with peers, replay of recorded runs.

This file contains the table of studies. It imports no large package, because the command's help reads it.
"""

import difflib
import os
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ccatp.config.models import Config
    from ccatp.studies.campaign import Study

Analysis: TypeAlias = "Callable[[Config, Path], dict[str, Any]]"
"""A study without runs: gets a configuration and a directory for files, returns the content of ``result.json``."""

# Name: module and the name in it of a Study or an Analysis; title.
STUDIES = {
    "thesis": ("ccatp.studies.thesis_study:STUDY", "the thesis's own simulation again, under several readings"),
    "filters": ("ccatp.studies.survey_studies:FILTERS", "filters in four worlds, over whole missions"),
    "time": ("ccatp.studies.survey_studies:TIME", "order, speed and measuring time against the hour"),
    "sensitivity": ("ccatp.studies.survey_studies:SENSITIVITY", "what each disturbance of a hard world costs"),
    "ablation": ("ccatp.studies.survey_studies:ABLATION", "what each technique gives, one off at a time"),
    "physics": ("ccatp.studies.physics_study:PHYSICS", "a rigid body on both mirrors: tyre, friction, thrust"),
    "bodies": ("ccatp.studies.physics_study:BODIES", "a rigid body with drawn tyres, contacts and accelerometer"),
    "stops": ("ccatp.studies.physics_study:STOPS", "a rigid body at the rim and on command: overrun by speed"),
    "slides": ("ccatp.studies.physics_study:SLIDES", "a rigid body whose friction falls: when that is found"),
    "danger": ("ccatp.studies.danger_study:STUDY", "false edges and overrun of two edge rules"),
    "faults": ("ccatp.studies.faults_study:STUDY", "whole missions with random faults: falls, completion"),
    "cricket": (
        "ccatp.beacons.studies.cricket_study:STUDY",
        "self-mapping of motes: the published figures, better ways",
    ),
    "mote-sizes": ("ccatp.beacons.studies.cricket_study:run_sizes", "time of self-mapping against the number of motes"),
    "mote-navigation": (
        "ccatp.beacons.studies.mote_navigation:STUDY",
        "a robot guided by motes that mapped themselves",
    ),
    "radio-signals": (
        "ccatp.beacons.studies.radio_studies:RADIO_SIGNALS",
        "levels and bearings of ZigBee radios, beside 2017",
    ),
    "radio-slam": (
        "ccatp.beacons.studies.radio_studies:RADIO_SLAM",
        "EKF-SLAM among ZigBee radios: rooms, slip, shadowing",
    ),
    "radio-cases": ("ccatp.beacons.studies.radio_studies:RADIO_CASES", "cases I to III of 2017 side by side with ours"),
    "radio-follow": ("ccatp.beacons.studies.radio_studies:RADIO_FOLLOW", "a moving radio followed, beside 2018"),
    "recordings": (
        "ccatp.beacons.studies.recordings:RECORDINGS",
        "estimators on recorded runs among beacons, from several starts",
    ),
    "damage": ("ccatp.beacons.studies.damage:STUDY", "the filter on damaged recordings: recovered, reported or wrong"),
    "loops": ("ccatp.studies.loops:run", "Bode plots, margins and root loci of the controllers"),
}


def find_study(name: str) -> "Study | Analysis":
    """The study of a name. Raises CampaignError: there is none."""
    from ccatp.studies.campaign import CampaignError, Study  # noqa: PLC0415

    if name not in STUDIES:
        near = difflib.get_close_matches(name, STUDIES, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(STUDIES)}"
        raise CampaignError(f"no study {name!r}; {hint}")
    place, title = STUDIES[name]
    module, _, attribute = place.partition(":")
    found: Study | Analysis = getattr(import_module(module), attribute)
    return replace(found, name=name, title=title) if isinstance(found, Study) else found


def limit_threads() -> None:
    """Limit linear algebra to one thread, here and in child processes; has an effect only before numpy is imported.

    For such small matrices more threads are slower, and compete with the workers.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
