"""Monte Carlo campaigns, comparisons with published results and with peers, replay of recorded runs.

This file contains the table of studies. It imports no large package, because the command's help reads it.
"""

import difflib
import os
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

from ccatp.missions import built_in

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ccatp.config.models import Config
    from ccatp.studies.campaign import Study

Analysis: TypeAlias = "Callable[[Config, Path], dict[str, Any]]"
"""A study without runs: gets a configuration and a directory for files, returns the content of ``result.json``."""

# Name: module and the name in it of a Study or an Analysis; title.
_OF_SURVEYS = {
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
    "loops": ("ccatp.studies.loops:run", "Bode plots, margins and root loci of the controllers"),
}
STUDIES = _OF_SURVEYS | {name: study for kind in built_in() for name, study in kind.studies.items()}


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
