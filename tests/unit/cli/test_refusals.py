"""What the command line refuses: one line on standard error, and the exit status 2."""

import shlex
import shutil
from pathlib import Path

import pytest

from ccatp.config.package import configs_dir
from ccatp.links.topics import schema_of
from ccatp.records.recorder import Recorder
from tests.support.command import refused
from tests.unit.beacons.cli.test_radio import CORNERS, places
from tests.unit.beacons.cli.test_radio_map import ranges_file, truth_file
from tests.unit.beacons.cricket.fields import ALL
from tests.unit.beacons.datasets.sets import csv_lines, world, write_lines

FILES = {
    "sheets/rnd.csv": b"\xff\xfe\x00\xd8",
    "sheets/flat.csv": b"distance_m,rssi_dbm\n1,-60\n2,-50\n3,-40\n",
    "one.csv": b"name,x_m,y_m\nM0,0,0\n",
    "tag.csv": b"name,x_m,y_m\ntag0,0,0\n",
    "tags.csv": b"name,x_m,y_m\ntag0,0,0\ntag1,0.2,0\ntag2,0,0.2\n",
    "session.csv": b"session,pos,deg,anchor,tag,mean_m\n"
    + b"".join(b"s,1,0,%d,%d,%d\n" % (a, t, 3 + a + t) for a in range(4) for t in range(3)),
    "negative.csv": b"first,second,range_m\nA,B,-1.0\n",
    "parts.csv": b"first,second,range_m\nA,B,1.0\nC,D,1.0\n",
    "few.csv": b"first,second,range_m\nA,B,1.0\nB,C,1.0\nC,D,1.0\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sound files and spoilt ones, and a run among beacons."""
    made = tmp_path_factory.mktemp("files")
    for name in ("sheets", "beacons"):
        (made / name).mkdir()
    for name, content in FILES.items():
        (made / name).write_bytes(content)
    write_lines(made / "mine.csv", csv_lines(world(seconds=5.0)))
    places(made / "sheets")
    ranges_file(made / "ranges.csv", ALL)
    truth_file(made / "truth.csv")
    shutil.copy(configs_dir() / "zigbee.toml", made / "beacons" / "config.toml")
    Recorder(made / "beacons" / "telemetry.mcap", [("truth", schema_of("truth"))], is_simulation=True).close()
    return made


FIX = f"radio fix sheets/places.csv {shlex.join(CORNERS)}"
GAP = 'radio fuzzy --set \'control.fuzzy.rules=[{when={distance_m="near"},then="slow"}]\''
IN_SPACE = "--set cricket.dimension=3 --set cricket.layout=random --set cricket.random.size_m=[1,1,1]"
APART = "--set cricket.layout=random --set cricket.random.count=30 --set cricket.random.reach_m=9"
OF_BEACONS = 'is of a mission among beacons (system = "zigbee"), and this is for surveys of mirrors alone; use ccatp'
# What takes a name; none that no file may have.
NAMING = ("report", "replay", "map", "run --sim --mirror", "run --sim --world")

REFUSED = [
    ("rnu", "ccatp: No such command 'rnu'. Did you mean 'run'?; see ccatp --help\n"),
    ("sim robto", "ccatp: No such command 'robto'. Did you mean 'robot'?; see ccatp sim --help\n"),
    ("sim zzz", "ccatp: No such command 'zzz'; see ccatp sim --help\n"),
    ("run", "ccatp: name the robot's configuration with --config FILE, or add --sim; see ccatp run --help\n"),
    ("run --sim --resume", "--resume: 0 unfinished runs in ./runs; name one with --run-dir"),
    ("run --sim --miror x", "Did you mean one of: '--mirror'"),
    ("run --sim --set seed", "'seed' is not KEY=VALUE, as in run.seed=2"),
    (f"run --sim --set {'.'.join('a' * 99)}=1", "is not KEY=VALUE"),
    ("run --sim --start-held", "--start-held needs --resume; --resume-last always starts held"),
    ("run --sim --resume-last --resume", "--resume-last finds the run itself: leave out --resume"),
    ("run --sim -q -v", "--quiet and --verbose contradict each other"),
    ("run --sim --held", "--held is now called --start-held"),
    ("run --sim --recover", "--recover is now called --resume-last"),
    ("log info x", "the command 'log' is now called 'recording'"),
    ("recording recover x", "the command 'recover' is now called 'repair'"),
    ("map x", "the command 'map' is now called 'plot'"),
    ("run --sim --seed one", "'one' is not a valid integer"),
    ("run --config a.toml --faults plan.toml", "--faults needs --sim: faults are for the simulated"),
    ("run --sim --faults none.toml", "ccatp: none.toml: no such file or directory; name a TOML file"),
    ("run --config tonight --sim", "'--config': tonight: no such file, and no configuration by that"),
    *((f"{command} {300 * 'x'}", "ccatp: ") for command in NAMING),
    ("sim robot --faults none.toml", "ccatp: none.toml: no such file or directory; name a TOML file"),
    ("sim etalon --puck 1 2 3 --truth ipc://x", "--puck and --truth exclude each other"),
    ("sim etalon --puck nan 0 0", "each of X Y Z is a number of metres, at most 1000 from the"),
    ("sim etalon --puck 0 0 -inf", "each of X Y Z is a number of metres"),
    ("sim etalon --truth foo", "'foo' is no endpoint; give ipc://PATH, as ccatp sim robot prints it"),
    ("sim etalon --truth tcp://a", "'tcp://a' is no endpoint"),
    ("sim etalon --truth ipc://x --runtime-dir x", "leave out --puck and --truth"),
    ("emergency fier", "'fier' is not one of 'fire', 'earthquake', 'power', 'weather', 'operator'"),
    *(
        (f"{command} --timeout {time_s}", f"'--timeout': {time_s} is no time to wait; give more than 0 s")
        for command, times_s in (
            ("status", ("0", "-1", "nan", "inf", "1e300", "soon")),
            *((command, ("0",)) for command in ("pause", "emergency fire", "conformance 127.0.0.1:7010")),
        )
        for time_s in times_s
    ),
    ("config check none.toml", "ccatp: none.toml: no such file or directory; name a TOML file that exists\n"),
    ("config check zigbe", "zigbe: no such file, and no configuration by that name; did you mean zigbee?"),
    ("conformance 7010", "'7010' is not HOST:PORT, as in 127.0.0.1:7010"),
    ("conformance host:70100", "'host:70100' is not HOST:PORT"),
    ("conformance 127.0.0.1:7010 --only ttl-drve", "no check 'ttl-drve'; did you mean ttl-drive?"),
    ("conformance 127.0.0.1:7010 --only zzz", "no check 'zzz'; available: "),
    ("completion bahs", "'bahs' is not one of 'bash', 'zsh', 'fish'"),
    ("stream --no-plotjuggler", "nothing to serve"),
    ("stream --host 0.0.0.0", "--open-to-network"),
    ("plan --mirror fyst-m3", "fyst-m3"),
    ("plan --panels -1", "run.panels"),
    ("plan --panels 999", "run.panels = 999, but fyst-m1 has 77 panels; 0 takes all of them"),
    ("plan --set limits.v_max_m_s=1e-300", "limits.v_max_m_s = 1e-300 must be greater than or equal to 0.001"),
    (
        "plan --set mirror.surface.normalisation_radius_mm=1e-300",
        "normalisation_radius_mm = 1e-300 must be greater than or equal to",
    ),
    ("plan --figure nowhere/plan.png", "--figure: no directory nowhere; make it first"),
    ("plan --panels 1 --figure plan.tiff7", "--figure: plan.tiff7: no format by that name; the file may end in"),
    # A run among beacons is named as such.
    ("align beacons", f"beacons/config.toml: {OF_BEACONS} report beacons\n"),
    ("replay beacons", f"beacons/config.toml: {OF_BEACONS} report beacons\n"),
    ("calibrate --from beacons", f"beacons/config.toml: {OF_BEACONS} report beacons\n"),
    ("plot beacons", "beacons: a mission among beacons; this is for surveys, ccatp report takes both"),
    ("check --sim --config zigbee", f"zigbee.toml: {OF_BEACONS} run or ccatp study with it\n"),
    (
        "run --sim --config zigbee --set follow.is_active=true",
        'sim.target.motion = "none": there is no radio that the simulated robot could follow; give "random"',
    ),
    (
        "run --sim --config cricket --set listener.mapping_rounds=20",
        "listener.mapping_rounds = 20: the map needs cricket.ranging.repeats = 60 readings of each pair",
    ),
    ("radio calibrate nowhere.csv", "no such file"),
    ("radio calibrate sheets/rnd.csv", "is not text; give a CSV file or an .xlsx workbook with columns of levels"),
    ("radio calibrate sheets/flat.csv", "flat.csv: levels do not fall with distance"),
    ("radio fix nowhere.csv", "give the place of two beacons"),
    ("radio fix nowhere.csv --beacon A", "is not NAME=X,Y"),
    ("radio fix nowhere.csv --beacon A=0,0 --beacon B=0,4", "no such file"),
    ("radio fix nowhere.csv --beacon A=0,0 --beacon B=0,0", "which bounds no room"),
    (f"{FIX} --path-loss sheets/flat.csv", "flat.csv: levels do not fall"),
    (FIX, "give either --fingerprints or --path-loss"),
    (f"{FIX} --room 1,2", "is not X0,Y0,X1,Y1"),
    (f"{FIX} --room 1,2,0,3", "its second corner"),
    (f"{FIX} --room 0,0,1,inf", "must be numbers within"),
    (f"{FIX} --spacing 0", "must be above 0 and at most the room's longer side 6 m"),
    (f"{FIX} --spacing nan", "must be above 0"),
    (f"{FIX} --spacing 1e-4", "more than 250000 points in a room of 6 by 6 m; give 0.012 m or more"),
    (f"{FIX} --beacon A=1,1", "A was given before"),
    (f"{FIX} --beacon D=nan,0", "--beacon D=nan,0: must be numbers within ±10000, in metres"),
    (f"{FIX} --beacon =1,0", "--beacon =1,0: has no name"),
    (f"{FIX} --exchange A,Z", "is not two beacons of the data, which has A, B, C"),
    (GAP, "no rule of the fuzzy controller fires"),
    ("radio fuzzy --figure none/b.png", "--figure: no directory"),
    *(
        (f"radio fuzzy --at {at}", "wants a distance >= 0 m and a finite angle")
        for at in ("nan 0.5", "-3 0.5", "1 inf", "inf 0")
    ),
    ("radio slam missing", "missing: no such file or folder"),
    ("radio slam sheets", "its header (x, y, RSSI A, RSSI B, RSSI C) has no column with a time"),
    ("radio slam sheets --format labyrinth", "holds no Labyrinth text"),
    ("radio slam mine.csv --robot 1", "a csv set has one vehicle: leave out --robot"),
    ("radio slam mine.csv --format labyrinth", "mine.csv:2: 'event,time_s,...' is none of range2"),
    ("radio slam mine.csv --format lidar", "'lidar' is not one of"),
    ("radio slam mine.csv --filter particle", "'particle' is not one of"),
    ("radio slam mine.csv --figure no/map.png", "--figure: no directory"),
    ("radio slam mine.csv --figure map.wrong", "map.wrong: no format by that name"),
    ("radio slam mine.csv --set csv.radio.range_sigma_m=-1", "csv.radio.range_sigma_m"),
    ("radio slam mine.csv --set csv.radio.nothing=1", "csv.radio.nothing"),
    ("radio map --config ccatp", "ccatp.toml: is the configuration of a survey of a mirror"),
    ("radio map --ranges ranges.csv --truth one.csv", "--truth: no place of M1, M2, M3, M4, M5; there are M0"),
    (f"radio map --ranges ranges.csv --truth truth.csv {IN_SPACE}", "--truth: M0 has 2 coordinates, wanted 3"),
    ("radio map --ranges ranges.csv --tags one.csv", "--tags: these ranges are of no trolley"),
    ("radio map --ranges session.csv --tags tag.csv", "--tags: no place of tag1; there are tag0"),
    ("radio map --ranges session.csv --tags tags.csv --method ekf", "the filter maps no trolleys"),
    ("radio map --ranges ranges.csv --figure m.gifx", "m.gifx: no format by that name"),
    ("radio map --ranges none.csv", "none.csv: no such file"),
    ("radio map --ranges r.csv --seeds 2", "--seeds is for simulated ranges"),
    ("radio map --ranges negative.csv", ":2: range of -1 m is no distance"),
    ("radio map --ranges parts.csv", "the motes fall into 2 parts"),
    ("radio map --ranges few.csv", "3 pairs of 4 motes were measured, a map in 2"),
    ("radio map --tags t.csv", "--tags and --truth go with --ranges"),
    ("radio map --out no/b.toml", "--out: no directory"),
    ("radio map --dimension 3", 'cricket.dimension = 3 needs layout = "motes" or "random"'),
    ("radio map --method ekf --set cricket.transducer.reach_m=[1,1,1,1,1]", "no pair of phase 2 receives each other"),
    ("radio map --method ekf --set cricket.phase1.max_dop=5", "N2-1 from N1-1, N1-2, N1-3: dilution of precision"),
    (f"radio map {APART}", "the motes fall into"),
]


@pytest.mark.parametrize(("command", "message"), REFUSED)
def test_what_cannot_be_is_one_line_and_status_2(
    command: str, message: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert message in refused(capsys, *shlex.split(command))
