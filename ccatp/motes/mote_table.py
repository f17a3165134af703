"""Pure. The result of a self-mapping in words."""

from collections.abc import Iterator
from typing import Any


def report_lines(data: dict[str, Any]) -> Iterator[str]:
    """What ``ccatp radio map`` prints without ``--json``: first what the ranges can tell, then what was found.

    Args:
        data: as ``--json`` prints it.
    """
    yield f"{data['motes']} motes, {data['method']}, frame {data['frame']}, {data['seeds']} runs"
    yield ""
    yield "what the ranges can tell"
    yield f"  free directions beyond the frame   {data['rank_deficiency']}"
    for line in data["free_directions"]:
        yield f"    {line}"
    yield f"  other maps fit as well             {'yes' if data['fold_over_risk'] else 'no'}"
    yield f"  least error (Cramér-Rao)           {_mm(data['crlb_m'])}"
    yield ""
    yield "what was found"
    yield f"  after phase 1                      {_mm(data['phase1_rms_m'])}"
    rms = data["rms_m"]
    yield f"  error, median (10 to 90 %)         {_mm(rms['p50'])} ({_mm(rms['p10'])} to {_mm(rms['p90'])})"
    if data.get("motes_in_doubt"):
        yield f"  motes in doubt                     {data['motes_in_doubt']}"
        yield f"  error of the others                {_mm(data['rms_of_others_m'])}"
    yield f"  expected by the estimator          {_mm(data['expected_rms_m'])}"
    yield f"  updates or steps                   {data['iterations']}"
    if data["offset_m"] != 0.0:
        yield f"  common offset of the ranges        {_mm(data['offset_m'])}"
    if data["scale"] != 1.0:
        scale = "unknown" if data["scale"] is None else f"{data['scale']:.6f}"
        yield f"  common scale of the ranges         {scale}"


def _mm(value_m: float | None) -> str:
    return "unknown" if value_m is None else f"{1e3 * value_m:.3g} mm"
