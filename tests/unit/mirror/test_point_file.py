"""Files of points as instruments, spreadsheets and people write them: each gives the panels, or one line that says why.

All are made from the same simulated targets; none may give other panels without a word.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.core import FloatArray
from tests.support.targets import OFFSET_M, SIGMA_UM, is_recovered, labels, places, rows

POINTS, NAMES = places(), labels()
OFFSET = "--offset-mm", str(1e3 * OFFSET_M)
SIGMA = "--sigma-um", str(SIGMA_UM)
RIGHT = ""


def table(separator: str, write: Callable[[float], str] = "{:.4f}".format, *, end: str = "\n", head: str = "") -> str:
    lines = [separator.join([name, *map(write, place)]) for name, place in zip(NAMES, POINTS.tolist(), strict=True)]
    return head + end.join(lines) + end


def decimal_comma(value: float) -> str:
    return f"{value:.4f}".replace(".", ",")


def german(value: float) -> str:
    return f"{value:,.4f}".translate(str.maketrans(",.", ".,"))


def with_sigmas(*sigmas: str, head: str = "", separator: str = ",") -> str:
    return head + "\n".join(separator.join([row.replace(",", separator), *sigmas]) for row in rows(POINTS, NAMES))


def renamed(names: list[str], points: FloatArray = POINTS) -> str:
    return "\n".join(rows(points, names))


def changed(line: int, text: str, points: FloatArray = POINTS) -> str:
    lines = rows(points, NAMES)
    lines[line - 1] = text
    return "\n".join(lines)


HEADERS = "PointId", "Punkt", "Punktnummer", "Pt", "Nr", "Panel", "Nom", "Point_No.", "word that nobody knows"


def renamed_head(head: str, points: FloatArray) -> str:
    return head + renamed(NAMES, points)


def in_columns(head: str, cells: Callable[[str], list[str]], points: FloatArray = POINTS) -> str:
    return f"{head},x,y,z\n" + renamed([",".join(cells(name)) for name in NAMES], points)


def many_readings() -> str:
    return "\n".join(line for seed in range(20) for line in rows(places(seed=seed), NAMES))


def of_observatory(form: str = "11{1}{0}1") -> list[str]:
    """Telescope, mirror, column, row, number."""
    return [form.format(*name.split("/")) for name in NAMES]


# Name: content, arguments, and what the line says; nothing if the panels are right.
FILES: dict[str, tuple[str | bytes, tuple[str, ...], str]] = {
    # Separators, numbers, encodings.
    "commas": (table(","), SIGMA, RIGHT),
    "tabs, lines of Windows": (table("\t", end="\r\n"), SIGMA, RIGHT),
    "semicolons and decimal commas": (table(";", decimal_comma), SIGMA, RIGHT),
    "tabs, decimal commas, points of thousands": (table("\t", german), SIGMA, RIGHT),
    "tabs, commas of thousands": (table("\t", "{:,.4f}".format), SIGMA, RIGHT),
    "semicolons, blanks of thousands": (table(";", lambda v: f"{v:,.4f}".replace(",", "\u00a0")), SIGMA, RIGHT),
    "apostrophes of thousands": (table("\t", lambda v: f"{v:,.4f}".replace(",", "'")), SIGMA, RIGHT),
    "three decimals with a comma": (table(";", lambda v: f"{v:.3f}".replace(".", ",")), SIGMA, RIGHT),
    "quotes around decimal commas": (table(",", lambda v: f'"{decimal_comma(v)}"'), SIGMA, RIGHT),
    "exponents": (table(" ", "{:.8E}".format), SIGMA, RIGHT),
    "long minus": (table("\t", lambda v: f"{v:.4f}".replace("-", "\u2212")), SIGMA, RIGHT),
    "separators at the end": (table(";").replace("\n", ";;\n"), SIGMA, RIGHT),
    "empty lines and lines of separators": (table(",").replace("\n", "\n\n,,,\n"), SIGMA, RIGHT),
    "byte order mark": (table(",").encode("utf-8-sig"), SIGMA, RIGHT),
    "UTF-16 of a spreadsheet": (table("\t", decimal_comma).encode("utf-16"), SIGMA, RIGHT),
    "UTF-16 without a mark": (table("\t").encode("utf-16-le"), SIGMA, "is no text in UTF-8"),
    "Latin-1": (table(",", head="# \u00b5m\n").encode("latin-1"), SIGMA, "is no text in UTF-8"),
    "decimal commas between commas": (table(",", decimal_comma), SIGMA, "a decimal comma takes quotes"),
    "one line with decimal points": (
        table(";", decimal_comma).replace(",", ".", 3), SIGMA, "has a decimal comma, ",
    ),
    "Fortran's exponents": (table(",", lambda v: f"{v:.6E}".replace("E", "D")), SIGMA, "neither a point nor a header"),
    # Headers and columns.
    "header of a tracker": (table(",", head="Point Name,X (mm),Y (mm),Z (mm)\n"), SIGMA, RIGHT),
    "columns that are not ours": (
        "Group,Name,Z,Y,X,Time\n"
        + "\n".join(f"A,{n},{z},{y},{x},12:00:01" for n, (x, y, z) in zip(NAMES, POINTS.tolist(), strict=True)),
        SIGMA, RIGHT,
    ),
    "Polyline of a tracker": (
        "Enabled\tFeature     \tID\tx         \ty       \tz       \ti\tj\tk\tDev From Fit\tProbe\n"
        + "".join(
            f"Checked\tPolyline 3X3\t{k + 1} \t{x:,.3f}\t{y:,.3f} \t{z:,.3f}\t \t \t \t0.000       \t3    \n"
            for k, (x, y, z) in enumerate(POINTS.tolist())
        ),
        SIGMA, RIGHT,
    ),
    "a point that the operator has excluded": (
        "Enabled,ID,x,y,z\n"
        + "\n".join(f"{'Unchecked' if k == 4 else 'Checked'},{row}" for k, row in enumerate(rows(POINTS, NAMES))),
        SIGMA, "is marked 'Unchecked'",
    ),
    "eight columns of photogrammetry, the last 0": (with_sigmas("0.015", "0.015", "0.015", "0.000"), (), RIGHT),
    "eight columns, the last no 0": (with_sigmas("0.015", "0.015", "0.015", "0.100"), (), "of more columns a first"),
    "collection, group and target": (
        "\n".join(f"A,Panels,{row}" for row in rows(POINTS, NAMES)), SIGMA, "of more columns a first line",
    ),
    "collection, group and target, named": (
        "collection,group,target,x,y,z\n" + "\n".join(f"A,Panels,{row}" for row in rows(POINTS, NAMES)), SIGMA, RIGHT,
    ),
    "coordinates in mm, sigmas in um": (
        with_sigmas("15", "15", "15", head="label,x_mm,y_mm,z_mm,sx_um,sy_um,sz_um\n"), (), RIGHT,
    ),
    "micrometres with the letter mu": (
        with_sigmas("15", head="label,X [mm],Y [mm],Z [mm],sigma [\u00b5m]\n"), (), RIGHT,
    ),
    "header in m": (table(",", lambda v: f"{v / 1e3:.7f}", head="label,x_m,y_m,z_m\n"), SIGMA, RIGHT),
    "header in inches": (table(",", head="Name,X (in),Y (in),Z (in)\n"), SIGMA, "is in in; export it in one of"),
    "mixed units in the header": (table(",", head="label,x_mm,y_m,z_mm\n"), SIGMA, "mixed units"),
    "header against --unit": (table(",", head="label,x_mm,y_mm,z_mm\n"), (*SIGMA, "--unit", "m"), "give one of them"),
    "nominal and measured coordinates": (
        "label,x,y,z,x,y,z\n" + "\n".join(f"{row},1.0,2.0,3.0" for row in rows(POINTS, NAMES)),
        SIGMA, "two columns are x",
    ),
    "header without x": (table(",", head="Name,East,North,Up\n"), SIGMA, "neither a point nor a header"),
    "title line": (table(",", head="Survey of M1, 2026-11-03\n"), SIGMA, "neither a point nor a header"),
    "line of units": (table(",", head="label,x,y,z\n,mm,mm,mm\n"), SIGMA, "put # before a line that is no point"),
    "line at the end": (table(",") + "27 points, , ,\n", SIGMA, ":28: '27 points' is no point"),
    "text between the points": (changed(6, "! text"), SIGMA, ":6: '! text' is no point"),
    "words between the points": (changed(6, "more text here"), SIGMA, ":6: 'more text here' is no point"),
    "a label alone": (changed(6, "4/5/6,,,"), SIGMA, ":6: '4/5/6' is no point"),
    **{
        f"labels under {word}": (table(";", head=f"{word};X [mm];Y [mm];Z [mm]\n"), SIGMA, RIGHT)
        for word in HEADERS
    },
    **{
        f"labels under {word}, x mirrored": (
            renamed_head(f"{word},x,y,z\n", POINTS * [-1, 1, 1]), SIGMA, "a left-handed frame",
        )
        for word in HEADERS
    },
    "row, col and point": (in_columns("row,col,point", lambda name: name.split("/")), SIGMA, RIGHT),
    "row, col and point, x mirrored": (
        in_columns("row,col,point", lambda name: name.split("/"), POINTS * [-1, 1, 1]), SIGMA, "a left-handed frame",
    ),
    "panel and point": (in_columns("panel,point", lambda name: name.rsplit("/", 1)), SIGMA, RIGHT),
    "panel and point, x mirrored": (
        in_columns("panel,point", lambda name: name.rsplit("/", 1), POINTS * [-1, 1, 1]), SIGMA, "a left-handed frame",
    ),
    "number and name, x mirrored": (
        in_columns("Nr,Name", lambda name: [name[-1], name], POINTS * [-1, 1, 1]), SIGMA, "a left-handed frame",
    ),
    "two columns of names": (in_columns("a,b", lambda name: [name, name]), SIGMA, "columns 'a' and 'b' have names"),
    "row alone": (in_columns("row,point", lambda name: [name[0], name[-1]]), SIGMA, "of row and col one is missing"),
    "panel and another label": (
        in_columns("panel,name", lambda name: [name[:3], f"1/2/{name[-1]}"]), SIGMA, "name two panels",
    ),
    **{
        f"sigmas under {head}": (
            with_sigmas(sigma, sigma, sigma, head=f"Point Name,X (mm),Y (mm),Z (mm),{head}\n"), (), message,
        )
        for head, sigma, message in (
            ("Ux (1.0 sigma),Uy (1.0 sigma),Uz (1.0 sigma)", "0.015", RIGHT),
            ("Ux (2 sigma),Uy (2 sigma),Uz (2 sigma)", "0.030", RIGHT),
            ("Ux (k=2) [mm],Uy (k=2) [mm],Uz (k=2) [mm]", "0.030", RIGHT),
            ("U95x,U95y,U95z", "0.030", RIGHT),
            ("ux,uy,uz", "0.015", RIGHT),
            ("Ux,Uy,Uz", "0.030", "'Ux' does not say of how many sigmas it is"),
            ("Uncertainty X,Uncertainty Y,Uncertainty Z", "0.030", "'Uncertainty X' does not say of how many sigmas"),
            ("sx (2 sigma),sy,sz", "0.030", "are not of as many sigmas"),
            ("sx (0 sigma),sy (0 sigma),sz (0 sigma)", "0.030", "an uncertainty of 0 sigma is none"),
        )
    },
    "sx alone": (with_sigmas("0.015", head="label,x,y,z,sx\n"), (), "not all of sx, sy, sz"),
    "header without data": ("label,x,y,z\n", SIGMA, "a header and no points"),
    "empty": ("", SIGMA, "no points in it"),
    "comments alone": ("# a\n# b\n", SIGMA, "no points in it"),
    "blank in the label": (table(" ").replace("/", " "), SIGMA, "name the columns in a header"),
    # Standard deviations.
    "no sigma": (table(","), (), "no sigma; add columns"),
    "no sigma in one line": (
        with_sigmas("0.015", "0.015", "0.015").replace(",0.015", "", 3), (), "no sigma; add columns",
    ),
    "negative sigma": (with_sigmas("0.015", "-0.015", "0.015"), (), "a sigma is not positive"),
    "sigmas in um without a header": (with_sigmas("15", "15", "15"), (), "a sigma of 1.5e+04 um is none"),
    "sigmas in m beside mm": (with_sigmas("1.5e-05", "1.5e-05", "1.5e-05"), (), "a sigma of 0.015 um is none"),
    "--sigma-um in mm": (table(","), ("--sigma-um", "0.015"), "a sigma of 0.015 um is none"),
    # Places.
    "NaN": (changed(3, "4/5/3,nan,1.0,2.0"), SIGMA, "x is 'nan', which is no number"),
    "infinite": (changed(3, "4/5/3,1.0,inf,2.0"), SIGMA, "y is 'inf', which is no number"),
    "too large for a number": (changed(6, "4/5/6,1e400,0,0"), SIGMA, "x is '1e400', which is no number"),
    "one point elsewhere": (changed(6, "4/5/6,0.0,-2700.0,4000.0"), SIGMA, "1 of 27 points lies elsewhere (4/5/6)"),
    "one line in m": (
        changed(5, "4/5/5," + ",".join(str(v / 1e3) for v in POINTS[4])), SIGMA, "mixed units, 1 of",
    ),
    "all in m": (renamed(NAMES, POINTS / 1e3), SIGMA, "in metres"),
    "all in inches": (renamed(NAMES, POINTS / 25.4), SIGMA, "in inches"),
    "swapped axes": (renamed(NAMES, POINTS[:, [1, 0, 2]]), SIGMA, "swapped axes"),
    "left-handed": (renamed(NAMES, POINTS * [1, 1, -1]), SIGMA, "a left-handed frame"),
    "left-handed, x": (renamed(NAMES, POINTS * [-1, 1, 1]), SIGMA, "a left-handed frame"),
    "frame of the tracker": (renamed(NAMES, POINTS + np.array([2000, 500, -300])), SIGMA, "check --mirror, --frame"),
    "another mirror": (table(","), (*SIGMA, "--mirror", "fyst-m2"), "is not on fyst-m2: 27 of 27 points lie elsewhere"),
    "another mirror without names": (
        renamed([f"T{k}" for k in range(27)]), (*SIGMA, "--mirror", "fyst-m2"), "is not on fyst-m2",
    ),
    "offset of the wrong sign": (table(","), (*SIGMA, "--offset-mm", "-19.05"), "wrong sign"),
    "no offset": (table(","), (*SIGMA, "--offset-mm", "0"), "give --offset-mm"),
    "offset of another ball": (table(","), (*SIGMA, "--offset-mm", "6.35"), "give --offset-mm"),
    # Panels.
    "names of the observatory": (renamed(of_observatory()), SIGMA, RIGHT),
    "names of the observatory, row first": (renamed(of_observatory("11{0}{1}1")), SIGMA, RIGHT),
    "names with the site": (renamed(of_observatory("01-011{0}{1}1 V1")), SIGMA, RIGHT),
    "numbers that are no names": (renamed([str(11001 + k) for k in range(27)]), SIGMA, RIGHT),
    "names of the other mirror": (
        renamed(["12" + name[2:] for name in of_observatory()]), SIGMA, "is of mirror 2",
    ),
    "no names": (renamed([""] * 27), SIGMA, RIGHT),
    "coordinates alone": ("\n".join(row.partition(",")[2] for row in rows(POINTS, NAMES)), SIGMA, RIGHT),
    "25 points of a panel": ("\n".join(rows(places(5), labels(5))), SIGMA, RIGHT),
    "20 readings of each point": (many_readings(), SIGMA, RIGHT),
    "two panels with one name": (
        renamed([name.replace("5/4/", "4/5/") for name in NAMES]), SIGMA, "names panel 4/5, and lies on 5/4",
    ),
    "two points with one name": (renamed(["4/5/1", "4/5/1", *NAMES[2:]]), SIGMA, "names two points that are far"),
    "a panel that is not": (renamed(["4/99/1", *NAMES[1:]]), SIGMA, "no panel in row 4, column 99"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "args", "message"), FILES.values(), ids=[*FILES])
def test_a_file_gives_the_panels_or_one_line(
    content: str | bytes, args: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "points.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    given = {"--mirror": "fyst-m1", OFFSET[0]: OFFSET[1]} | dict(zip(args[::2], args[1::2], strict=True))
    code = main(["align", "--points", str(file), "--json", *(part for pair in given.items() for part in pair)])
    out, err = capsys.readouterr()
    if message:
        assert (code, out) == (2, "")
        (line,) = err.splitlines()
        assert message in line
    else:
        assert code == 0
        assert is_recovered(json.loads(out))


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_points_of_a_panel_are_said(count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "points.csv"
    file.write_text("\n".join(rows(POINTS, NAMES)[:count]), encoding="utf-8")
    assert main(["align", "--points", str(file), "--mirror", "fyst-m1", *OFFSET, *SIGMA]) == 0
    assert f"{count} of 3 points that it takes" in capsys.readouterr().out


def test_points_without_names_say_that_a_mirrored_axis_would_not_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mirror is symmetric: its panels may be those of the other side."""
    file = tmp_path / "points.csv"
    file.write_text(renamed([""] * 27, POINTS * [-1, 1, 1]), encoding="utf-8")
    assert main(["align", "--points", str(file), "--mirror", "fyst-m1", *OFFSET, *SIGMA]) == 0
    assert "27 readings are assigned to panels by position" in capsys.readouterr().err


@pytest.mark.parametrize(("sigma_um", "is_said"), [("15", False), ("25", False), ("900", True)])
def test_sigmas_that_are_much_too_large_are_said(
    sigma_um: str, is_said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "points.csv"
    file.write_text(renamed(NAMES), encoding="utf-8")
    assert main(["align", "--points", str(file), "--mirror", "fyst-m1", *OFFSET, "--sigma-um", sigma_um]) == 0
    assert ("these seem to be too large" in capsys.readouterr().err) == is_said


def test_an_outlier_has_the_name_of_its_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = POINTS + np.where(np.arange(27) == 13, 0.4, 0.0)[:, None]
    for names in (NAMES, [f"T{k}" for k in range(27)]):
        file = tmp_path / "points.csv"
        file.write_text(renamed(names, wrong), encoding="utf-8")
        assert main(["align", "--points", str(file), "--mirror", "fyst-m1", *OFFSET, *SIGMA]) == 0
        err = capsys.readouterr().err
        assert "outliers: 5/4/5" in err
        assert ("point 5/4/5 is 'T13' of the file" in err) == (names[0] == "T0")
