// The page: receives the state, shows it, and reports when nothing arrives.
import { Alarms, severity } from "./alarms.js";
import { Commands } from "./commands.js";
import { MapView } from "./map.js";
import { Plots } from "./plots.js";
import { explain, termOf } from "./terms.js";

const SILENCE_MS = 800;
const RETRY_MS = 1500;
const MAX_LINES = 200;
const HOLD = 4; // severity from which on an alarm holds the robot, or sends it home

const $ = (id) => document.getElementById(id);
const text = (id, value) => {
  const node = $(id);
  if (node.textContent !== value) node.textContent = value;
};
const two = (n) => String(n).padStart(2, "0");
const clock = (s) => {
  if (s === null || s === undefined || !Number.isFinite(s)) return "–";
  const all = Math.max(0, Math.round(s));
  const [h, m] = [Math.floor(all / 3600), Math.floor(all / 60) % 60];
  return h ? `${h}:${two(m)}:${two(all % 60)} h` : `${m}:${two(all % 60)} min`;
};
const age = (s) => (s === null ? "" : s < 9.95 ? `${s.toFixed(1)} s` : s < 120 ? `${Math.round(s)} s` : `${Math.round(s / 60)} min`);
// Time of the server's clock, because the clock of a phone may be wrong.
const utc = (s) => new Date(1000 * s).toISOString();
const day = (iso) => iso.slice(0, 10);
const hour = (iso) => iso.slice(11, 19);

const map = new MapView($("map"), $("legend"), $("ellipse"), $("fit"));
const plots = new Plots((name) => $(`plot-${name}`), $("plots-all"), $("engineer"), $("no-plots"));
const commands = new Commands();
const alarms = new Alarms(commands);
explain(document, $("explain"));

let source = null;
let receivedAt = performance.now();
let statusAge = null; // of the newest status when it came here, s
let isEnded = false;
let isDashboardGone = false;
let isConnecting = false;
let codes = [];
let words = {};
let hidden = [];
let limits = {};
let staleAfter = {};
const rowOfKind = new Map();

// -- the stream ---------------------------------------------------------------------------------------------------

async function connect() {
  if (isConnecting) return;
  isConnecting = true;
  try {
    const answer = await fetch("ground", { cache: "no-store" });
    if (!answer.ok) throw new Error(`ground: ${answer.status}`);
    begin(await answer.json());
    source?.close();
    source = new EventSource("events");
    source.addEventListener("all", (event) => receive(JSON.parse(event.data), true));
    source.addEventListener("news", (event) => receive(JSON.parse(event.data), false));
    source.addEventListener("end", (event) => end(JSON.parse(event.data)));
    source.onerror = () => {
      source.close(); // the next stream begins with the whole state
      setTimeout(connect, RETRY_MS);
    };
  } catch (error) {
    console.warn(error);
    setTimeout(connect, RETRY_MS);
  } finally {
    isConnecting = false;
  }
}

function begin(ground) {
  text("title", ground.title);
  text("subtitle", ground.subtitle);
  text("run", ground.run);
  text("version", `${ground.version} on ${ground.host}`);
  for (const row of document.querySelectorAll(".run .about")) row.remove();
  for (const [name, value] of ground.about) {
    const row = Object.assign(document.createElement("div"), { className: "about" });
    row.append(Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: value }));
    document.querySelector(".run").append(row);
  }
  document.title = `${ground.is_sim ? "SIM " : ""}${ground.title} – ccatp`;
  $("simulation").hidden = !ground.is_sim;
  ({ codes, words, limits } = ground);
  staleAfter = ground.stale_after_s;
  for (const [id, word] of Object.entries(words)) if ($(id)) text(id, word);
  for (const id of hidden) $(id).hidden = false; // the mission before may have been of another kind
  for (const id of ground.hides) $(id).hidden = true;
  hidden = ground.hides;
  plots.begin(ground.plots);
  map.begin(ground);
  alarms.begin(ground);
}

function receive(state, isAll) {
  receivedAt = performance.now();
  isEnded = isDashboardGone = false;
  $("ended").hidden = true;
  text("utc-name", "UTC");
  show(state, isAll);
}

// The survey has ended only if the main loop has reported it: a moving robot must not be shown as a standing one.
function end(state) {
  source.close();
  show(state, true);
  commands.end();
  isEnded = state.is_over;
  isDashboardGone = !isEnded;
  receivedAt = performance.now();
  text("utc-name", "last seen, UTC"); // the clock stands from here on
  if (isEnded) showEnd(state);
  showSilence();
  setTimeout(connect, RETRY_MS); // the next dashboard, or the next survey, may begin at the same place
}

function showEnd({ mission, utc_s }) {
  const { done, total } = mission;
  text("ended", `The daemon ended at ${hour(utc(utc_s))} UTC, with ${done} of ${total} ${words.goal} ${words.reached}. Nothing here changes any more.`);
  $("ended").hidden = false;
}

function showSilence() {
  const silent = performance.now() - receivedAt;
  showAge(silent / 1000);
  if (isEnded || !(isDashboardGone || silent > SILENCE_MS)) return;
  const what = isDashboardGone ? "the dashboard has ended; the survey may continue" : "the dashboard does not answer";
  showLoss([[what, silent / 1000]]);
}
setInterval(showSilence, 100);

// Of what is shown: whoever reads an old page must see that it is old.
function showAge(silentS) {
  const isGone = !isEnded && (isDashboardGone || silentS > SILENCE_MS / 1000);
  const old = statusAge === null ? "" : age(statusAge + silentS);
  $("turn").classList.toggle("stale", isGone);
  $("act").disabled = isGone;
  text("age", isEnded ? "the daemon has ended" : isGone ? `no daemon answers: what is shown is ${old || "–"} old` : old && `status ${old} old`);
}

// -- what is shown ------------------------------------------------------------------------------------------------

function showLoss(losses) {
  const node = $("alarm");
  node.hidden = losses.length === 0;
  document.body.classList.toggle("lost", losses.length > 0);
  if (losses.length === 0) return;
  text("alarm-text", losses.map(([what]) => what).join("; "));
  text("alarm-age", `${losses[0][1].toFixed(1)} s`);
}

function show(state, isAll) {
  showLoss(state.losses);
  showTimes(state);
  showTurn(state);
  showMission(state);
  showFacts(state.facts);
  showVerdict(state.verdict, state.is_over);
  alarms.receive(state, isAll);
  showRobot(state);
  showGauges(state);
  showLinks(state);
  showLog(state, isAll);
  map.receive(state, isAll);
  plots.receive(state.series, isAll);
  commands.receive(state);
}

function showTimes({ utc_s, started, mission, is_over }) {
  const now = utc(utc_s);
  text("utc", `${day(now)} ${hour(now)}`);
  text("started", started ? `${day(started) === day(now) ? "" : `${day(started)} `}${hour(started)}` : "–");
  const inS = is_over ? null : (mission?.finish_in_s ?? null);
  const finish = inS === null ? null : utc(utc_s + inS);
  text("finish", finish ? `${day(finish) === day(now) ? "" : `${day(finish)} `}${hour(finish).slice(0, 5)}` : "–");
}

// See docs/dashboard.md: a state that an operator commanded is not an alarm.
function levelOf({ mission, losses, alarms: list }) {
  const isGrave = list.some((alarm) => !alarm.ended && ["hold", "return", "fault"].includes(alarm.severity));
  if (losses.length) return "bad";
  if (mission.exit_status === 0) return "good";
  const { kind } = mission.turn;
  const isQuiet = ["ready", "work"].includes(kind) || (!kind && !["held", "backing off", "returning", "done"].includes(mission.state));
  if (isQuiet) return isGrave && kind === "ready" ? "bad" : mission.state === "idle" ? "" : "good";
  return isGrave ? "bad" : mission.is_by_operator ? "note" : "warn";
}

// One line: what the robot does and why, who acts next, the next action; a button only if the daemon would accept it.
function showTurn(state) {
  const { mission, is_over } = state;
  if (!mission) {
    text("state", "waiting for the main loop");
    text("next", "");
    return;
  }
  statusAge = mission.age_s;
  const { does, who, then, request } = mission.turn_text;
  text("state", does);
  $("state").dataset.level = levelOf(state);
  $("state").classList.toggle("stale", mission.is_stale);
  text("next", then ? `Next: ${who} ${then}`.replace(/ +/g, " ") : "");
  $("turn").dataset.actor = mission.turn.actor;
  $("act").hidden = is_over || !request || !commands.token || state.losses.length > 0;
  text("act", { resume: "Resume", clear: "Clear …" }[request] ?? "");
  $("act").onclick = () => (request === "clear" ? alarms.clearFirst() : commands.press(request));
}

// Time to the end means something only while the mission makes progress.
const isUnderWay = ({ mission, is_over }) => !is_over && !mission.outcome && ["", "work", "retreat", undefined].includes(mission.turn.kind) && mission.state !== "returning";

function showMission(state) {
  const { mission } = state;
  if (!mission) return;
  text("done", String(mission.done));
  text("total", String(mission.total));
  $("progress").max = Math.max(mission.total, 1);
  $("progress").value = mission.done;
  text("elapsed", clock(mission.elapsed_s));
  text("eta", isUnderWay(state) ? clock(mission.eta_s) : "–");
  text("point", mission.next_point || "–");
  text("arrival", mission.done ? `${mission.error_mm.toFixed(2)} mm` : "–");
  text("skipped", String(Math.max(mission.skipped, mission.not_to_be_measured)));
  $("bad-lines-row").hidden = !mission.bad_lines;
  text("bad-lines", `${mission.bad_lines}, the first: ${mission.bad_line}`);
  text("late-frames", mission.missed_deadlines ? `${mission.missed_deadlines} (${mission.worst_lateness_ms.toFixed(0)} ms)` : "0");
}

// Names and values of further facts of a mission.
function showFacts(facts) {
  const list = $("facts");
  list.hidden = !facts?.length;
  if (list.hidden) return;
  while (list.children.length < facts.length) {
    const row = document.createElement("div");
    row.append(document.createElement("dt"), document.createElement("dd"));
    list.append(row);
  }
  while (list.children.length > facts.length) list.lastChild.remove();
  facts.forEach((fact, k) => fact.forEach((words, column) => {
    const node = list.children[k].children[column];
    if (node.textContent !== words) node.textContent = words;
  }));
}

// The event code and the severity of what is found are two things; after the end nothing is permitted or denied.
function showVerdict(verdict, isOver) {
  if (!verdict) return;
  const level = verdict.severity >= HOLD ? "bad" : verdict.text || verdict.severity ? "warn" : "good";
  const grave = verdict.severity ? `${severity(verdict.severity)}: ` : "";
  text("verdict", verdict.text ? `${grave}${verdict.text}` : "nothing found");
  text("code", `${verdict.code} ${codes[verdict.code] ?? ""}`);
  $("verdict").dataset.level = level;
  $("verdict").classList.toggle("stale", Boolean(verdict.is_stale) || isOver);
  for (const way of ["forward", "reverse", "turn"]) {
    const is = verdict[way];
    $(`permit-${way}`).dataset.on = is === undefined || isOver ? "" : is && !verdict.is_stale ? "yes" : "no";
  }
}

function showRobot({ robot, pose, mission }) {
  const edges = robot?.edges ?? [];
  const names = ["front left", "front right", "rear left", "rear right"];
  names.forEach((name, k) => ($(`edge-${k}`).dataset.on = edges.length ? (edges[k] ? "yes" : "no") : ""));
  const off = names.filter((_, k) => edges.length && !edges[k]);
  const label = !edges.length ? "Edge sensors: not known" : off.length ? `Edge sensors off the panel: ${off.join(", ")}` : "Edge sensors: all on a panel";
  if ($("edges").getAttribute("aria-label") !== label) {
    $("edges").setAttribute("aria-label", label);
    $("edges").title = label;
  }
  const held = { held: "held by the mission", idle: "held, the mission has not begun", done: "held, the mission is over" };
  text("held", !robot ? "–" : robot.is_held ? "held by the robot's own rules" : held[mission?.state] ?? "follow the drives");
  $("faults").hidden = !robot?.faults.length;
  text("faults", robot?.faults.length ? `■ Robot reports: ${robot.faults.join(", ")}` : "");
  text("pose-xy", pose ? `${pose.x_m.toFixed(3)}, ${pose.y_m.toFixed(3)} m` : "–");
  text("pose-heading", pose ? `${((pose.heading_rad * 180) / Math.PI).toFixed(1)}°` : "–");
  const [xx, , yy] = pose?.covariance_m2 ?? [0, 0, 0];
  text("pose-sigma", pose ? `${(3000 * Math.sqrt(Math.max(xx, yy, 0))).toFixed(2)} mm` : "–");
}

// For each value: name, value, limit, whether it must be above the limit, range of the bar, format.
function showGauges({ robot, laser, sensors_age_s, mission }) {
  const percent = (value) => `${Math.round(100 * value)} %`;
  const ms = (value) => (value < 0.9995 ? `${Math.round(1000 * value)} ms` : `${value.toFixed(1)} s`);
  const fan = (k) => [`fan ${["left", "right"][k]}`, robot?.fans[k], limits.fan_share ? limits.fan_share * limits.fan_duty[k] : null, true, 1, percent];
  const rows = [
    ...("charge" in limits ? [["battery", robot?.charge, limits.charge, true, 1, percent], fan(0), fan(1)] : [["battery", robot?.charge, null, true, 1, percent]]),
    ...("dop" in limits
      ? [
          ["laser DOP", laser?.dop, limits.dop, false, 1.3 * limits.dop, (value) => value.toFixed(1)],
          ["laser residual", laser?.residual_um, limits.residual_um, false, 1.3 * limits.residual_um, (value) => `${value.toFixed(value < 10 ? 1 : 0)} µm`],
        ]
      : []),
    ...("grip" in limits ? [["grip", mission?.grip || null, limits.grip, true, 3 * limits.grip, (value) => `${value.toFixed(1)} ×`]] : []),
    ["sensors, age", sensors_age_s, limits.sensors_age_s, false, 1.3 * limits.sensors_age_s, ms],
    ["permit, age", robot?.permit_age_s, limits.permit_age_s, false, 1.3 * limits.permit_age_s, ms],
    ["drive, age", robot?.drive_age_s, limits.drive_age_s, false, 1.3 * (limits.drive_age_s ?? limits.permit_age_s), ms],
  ];
  const list = $("gauges");
  rows.forEach(([name, value, limit, isLeast, most, write], k) => {
    let row = list.children[k];
    if (!row) {
      row = document.createElement("div");
      row.innerHTML = "<dt></dt><span class='bar'><b></b><u></u></span><dd></dd>";
      list.append(row);
    }
    const isKnown = value !== null && value !== undefined;
    const isBad = isKnown && limit != null && (isLeast ? value < limit : value > limit);
    const [head, bar, words] = row.children;
    row.dataset.level = isBad ? "bad" : "";
    if (head.textContent !== name) {
      head.textContent = name;
      const term = termOf(name);
      if (term) head.dataset.term = term;
      else delete head.dataset.term;
    }
    bar.children[0].style.width = `${isKnown ? Math.min((100 * value) / most, 100) : 0}%`;
    bar.children[1].hidden = limit == null;
    if (limit != null) bar.children[1].style.left = `${(100 * limit) / most}%`;
    const bound = limit == null ? "" : ` <small>${isLeast ? "≥" : "≤"} ${write(limit)}</small>`;
    const shown = `${isBad ? (isLeast ? "low " : "high ") : ""}${isKnown ? write(value) : "–"}${bound}`;
    if (words.innerHTML !== shown) words.innerHTML = shown;
  });
  while (list.children.length > rows.length) list.lastChild.remove();
}

function showLinks({ links, restarts, is_over }) {
  const list = $("links");
  while (list.children.length < links.length) {
    const row = document.createElement("li");
    row.append(document.createElement("b"), document.createElement("span"));
    list.append(row);
  }
  while (list.children.length > links.length) list.lastChild.remove();
  links.forEach((link, k) => {
    const row = list.children[k];
    const again = link.name === "main loop" ? restarts.main : link.name === "danger loop" ? restarts.danger : 0;
    const limit = staleAfter[link.name] ? ` ≤ ${staleAfter[link.name]} s` : "";
    row.dataset.well = link.age_s === null || is_over ? "idle" : link.is_well ? "yes" : "no";
    row.children[0].textContent = link.name;
    const phase = is_over ? "ended" : `${link.phase} ${age(link.age_s)}${link.age_s === null ? "" : limit}`;
    row.children[1].textContent = `${phase}${again ? ` (restarted ${again}×)` : ""}`;
  });
}

function showLog({ log, messages_left_out }, isAll) {
  const list = $("log");
  if (isAll) {
    list.replaceChildren();
    rowOfKind.clear();
  }
  for (const [at, level, line, times, kind] of log) {
    rowOfKind.get(kind)?.remove();
    const row = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = `${at.slice(5, 10)} ${hour(at)}Z`;
    time.dateTime = at;
    const sign = document.createElement("b");
    sign.textContent = level;
    const body = document.createElement("span");
    body.textContent = times > 1 ? `${line} (${times}×)` : line;
    row.dataset.level = level;
    row.append(time, sign, body);
    list.prepend(row);
    rowOfKind.set(kind, row);
  }
  let note = list.querySelector(".left-out");
  while (list.children.length > MAX_LINES + (note ? 1 : 0)) {
    const oldest = note ? note.previousElementSibling : list.lastElementChild;
    for (const [kind, row] of rowOfKind) if (row === oldest) rowOfKind.delete(kind);
    oldest.remove();
  }
  if (!messages_left_out) return;
  if (!note) {
    note = Object.assign(document.createElement("li"), { className: "left-out" });
    list.append(note);
  }
  note.textContent = `${messages_left_out.toLocaleString("en")} older messages are not shown: see log.jsonl`;
}

// -- keys ---------------------------------------------------------------------------------------------------------

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input") || document.querySelector("dialog[open]")) return;
  const act = {
    p: () => commands.press("pause"),
    r: () => commands.press("resume"),
    a: () => commands.arm(event.timeStamp),
    s: () => $("stop").focus(),
    f: () => map.toggleFollow(),
    "+": () => map.zoom(1.5),
    "-": () => map.zoom(1 / 1.5),
    0: () => map.fit(),
    Escape: () => commands.disarm(),
  }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act && !event.repeat) {
    act();
    event.preventDefault();
  }
});
$("zoom-in").onclick = () => map.zoom(1.5);
$("zoom-out").onclick = () => map.zoom(1 / 1.5);
$("fit").onclick = () => map.fit();
$("follow").onclick = () => map.toggleFollow();

connect();
