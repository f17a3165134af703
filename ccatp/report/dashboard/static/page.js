// The page: receives the state, shows it, and reports when nothing arrives.
import { Commands } from "./commands.js";
import { MapView } from "./map.js";
import { Plots } from "./plots.js";

const SILENCE_MS = 800;
const RETRY_MS = 1500;
const MAX_LINES = 200;
const LEVELS = { held: "bad", "backing off": "warn", returning: "warn", idle: "", done: "" };
const SEVERITIES = ["", "inform", "slow", "pause", "hold", "return", "fault"];

const $ = (id) => document.getElementById(id);
const text = (id, value) => {
  const node = $(id);
  if (node.textContent !== value) node.textContent = value;
};
const clock = (s) => {
  if (s === null || s === undefined || !Number.isFinite(s)) return "–";
  const all = Math.max(0, Math.round(s));
  const two = (n) => String(n).padStart(2, "0");
  return all >= 3600
    ? `${Math.floor(all / 3600)}:${two(Math.floor(all / 60) % 60)}:${two(all % 60)}`
    : `${Math.floor(all / 60)}:${two(all % 60)}`;
};
const age = (s) => (s === null ? "" : s < 9.95 ? `${s.toFixed(1)} s` : s < 120 ? `${Math.round(s)} s` : `${Math.round(s / 60)} min`);

const map = new MapView($("map"), $("legend"));
const plots = new Plots((name) => $(`plot-${name}`));
const commands = new Commands();

let source = null;
let receivedAt = performance.now();
let isEnded = false;
let isDashboardGone = false;
let isConnecting = false;
let codes = [];
let words = {};
let hidden = [];
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
  } catch {
    setTimeout(connect, RETRY_MS);
  } finally {
    isConnecting = false;
  }
}

function begin(ground) {
  text("title", ground.title);
  text("subtitle", ground.subtitle);
  document.title = `${ground.is_sim ? "SIM " : ""}${ground.title} – ccatp`;
  $("simulation").hidden = !ground.is_sim;
  ({ codes, words } = ground);
  for (const [id, word] of Object.entries(words)) if ($(id)) text(id, word);
  for (const id of hidden) $(id).hidden = false; // the mission before may have been of another kind
  for (const id of ground.hides) $(id).hidden = true;
  hidden = ground.hides;
  plots.begin(ground.plots);
  map.begin(ground);
}

function receive(state, isAll) {
  receivedAt = performance.now();
  isEnded = isDashboardGone = false;
  $("ended").hidden = true;
  show(state, isAll);
}

// The survey has ended only where the main loop has reported it: a driving robot must not be taken for a standing one.
function end(state) {
  source.close();
  show(state, true);
  commands.end();
  isEnded = state.is_over;
  isDashboardGone = !isEnded;
  receivedAt = performance.now();
  if (isEnded) showEnd(state.mission);
  showSilence();
  setTimeout(connect, RETRY_MS); // the next dashboard, or the next survey, may begin at the same place
}

function showEnd({ outcome, state, done, total }) {
  text("ended", `The daemon has ended: ${outcome || `while ${state}`}, ${done} of ${total} ${words.goal} ${words.reached}.`);
  $("ended").hidden = false;
}

function showSilence() {
  const silent = performance.now() - receivedAt;
  if (isEnded || !(isDashboardGone || silent > SILENCE_MS)) return;
  const what = isDashboardGone ? "the dashboard has ended; the survey may go on" : "the dashboard does not answer";
  alarm([[what, silent / 1000]]);
}
setInterval(showSilence, 100);

// -- what is shown ------------------------------------------------------------------------------------------------

function alarm(losses) {
  const node = $("alarm");
  node.hidden = losses.length === 0;
  document.body.classList.toggle("lost", losses.length > 0);
  if (losses.length === 0) return;
  text("alarm-text", losses.map(([what]) => what).join("; "));
  text("alarm-age", `${losses[0][1].toFixed(1)} s`);
}

function show(state, isAll) {
  alarm(state.losses);
  showMission(state);
  showFacts(state.facts);
  showVerdict(state.verdict);
  showAlarms(state.alarms);
  announce(state.alarms, isAll);
  showRobot(state.robot, state.pose);
  showLinks(state);
  showLog(state.log, isAll);
  map.receive(state, isAll);
  plots.receive(state.series, isAll);
  commands.receive(state);
}

function showMission({ mission, losses }) {
  if (!mission) {
    text("state", "waiting for the main loop");
    return;
  }
  const cause = mission.cause ? `: ${mission.cause}` : "";
  text("state", mission.outcome ? `done: ${mission.outcome}` : mission.state + cause);
  const isBad = losses.length > 0 || (mission.state === "done" && mission.exit_status > 0);
  $("state").dataset.level = isBad ? "bad" : (LEVELS[mission.state] ?? "good");
  $("state").classList.toggle("stale", mission.is_stale);
  text("done", String(mission.done));
  text("total", String(mission.total));
  $("progress").max = Math.max(mission.total, 1);
  $("progress").value = mission.done;
  text("elapsed", clock(mission.elapsed_s));
  text("eta", mission.outcome || mission.state === "returning" ? "–" : clock(mission.eta_s));
  text("point", mission.next_point || "–");
  text("arrival", mission.done ? `${mission.error_mm.toFixed(2)} mm` : "–");
  text("skipped", String(Math.max(mission.skipped, mission.not_to_be_measured)));
  text("slips", mission.missed_deadlines ? `${mission.missed_deadlines}, worst ${mission.worst_lateness_ms.toFixed(0)} ms` : "0");
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

function showVerdict(verdict) {
  if (!verdict) return;
  const grave = SEVERITIES[verdict.severity] ? `, ${SEVERITIES[verdict.severity]}` : "";
  text("verdict", `${verdict.code} ${codes[verdict.code] ?? ""}${grave}${verdict.text ? `: ${verdict.text}` : ""}`);
  $("verdict").dataset.level = verdict.code === 2 || verdict.severity >= 4 ? "bad" : verdict.code || verdict.severity ? "warn" : "";
  $("verdict").classList.toggle("stale", Boolean(verdict.is_stale));
  for (const way of ["forward", "reverse", "turn"]) {
    const is = verdict[way];
    $(`permit-${way}`).dataset.on = is === undefined ? "" : is && !verdict.is_stale ? "yes" : "no";
  }
}

// What an operator turned on: a tone and a notification of the browser for each grave alarm that is new.
const known = new Set();
let tones = null;
$("sound").onchange = () => {
  tones = $("sound").checked ? new AudioContext() : null;
  if (tones && "Notification" in window) Notification.requestPermission();
};

function announce(alarms, isAll) {
  const grave = alarms.filter((alarm) => !alarm.ended && SEVERITIES.indexOf(alarm.severity) >= SEVERITIES.indexOf("hold"));
  const fresh = grave.filter((alarm) => !known.has(`${alarm.name} ${alarm.count} ${alarm.severity}`));
  for (const alarm of fresh) known.add(`${alarm.name} ${alarm.count} ${alarm.severity}`);
  if (isAll || !tones || !fresh.length) return;
  const tone = tones.createOscillator();
  tone.frequency.value = 880;
  tone.connect(tones.destination);
  tone.start();
  tone.stop(tones.currentTime + 0.6);
  if ("Notification" in window && Notification.permission === "granted")
    new Notification(document.title, { body: fresh.map((alarm) => `${alarm.cause}. ${alarm.advice}`).join(" ") });
}

// A row is made again only when it changed: a button must stay where it is while it is pressed.
function showAlarms(alarms) {
  const list = $("alarms");
  $("alarms-card").hidden = alarms.length === 0;
  alarms.forEach((alarm, k) => {
    const key = JSON.stringify(alarm);
    if (list.children[k]?.dataset.key === key) return;
    const row = document.createElement("li");
    row.dataset.key = key;
    row.dataset.level = alarm.ended ? "" : SEVERITIES.indexOf(alarm.severity) >= SEVERITIES.indexOf("hold") ? "bad" : "warn";
    const add = (kind, words, id = "") => {
      const node = document.createElement(kind);
      node.textContent = words;
      node.className = id;
      row.append(node);
      return node;
    };
    const times = alarm.count > 1 ? `, ${alarm.count} times` : "";
    add("strong", alarm.cause);
    add("small", `${alarm.severity}${times}, since ${alarm.since.slice(11)}${alarm.ended ? `, ended ${alarm.ended.slice(11)}` : ""}`);
    if (alarm.advice) add("p", alarm.advice);
    if (alarm.acknowledged_by) add("small", `acknowledged by ${alarm.acknowledged_by}, ${alarm.acknowledged.slice(11)}`);
    else add("button", "Acknowledge", "acknowledge").onclick = () => commands.acknowledge(alarm.name);
    if (list.children[k]) list.children[k].replaceWith(row);
    else list.append(row);
  });
  while (list.children.length > alarms.length) list.lastChild.remove();
}

function showRobot(robot, pose) {
  const edges = robot?.edges ?? [];
  const names = ["front left", "front right", "rear left", "rear right"];
  names.forEach((name, k) => ($(`edge-${k}`).dataset.on = edges.length ? (edges[k] ? "yes" : "no") : ""));
  const off = names.filter((_, k) => edges.length && !edges[k]);
  const label = !edges.length ? "Edge sensors: not known" : off.length ? `Edge sensors off the panel: ${off.join(", ")}` : "Edge sensors: all on a panel";
  if ($("edges").getAttribute("aria-label") !== label) $("edges").setAttribute("aria-label", label);
  text("fans", robot ? robot.fans.map((duty) => `${Math.round(100 * duty)} %`).join(", ") : "–");
  text("charge", robot ? `${Math.round(100 * robot.charge)} %` : "–");
  text("held", robot ? (robot.is_held ? "held by the robot" : "free") : "–");
  text("ages", robot ? `${Math.round(1000 * robot.drive_age_s)}, ${Math.round(1000 * robot.permit_age_s)} ms old` : "–");
  $("faults").hidden = !robot?.faults.length;
  text("faults", robot?.faults.length ? `Robot reports: ${robot.faults.join(", ")}` : "");
  text("pose-xy", pose ? `${pose.x_m.toFixed(3)}, ${pose.y_m.toFixed(3)} m` : "–");
  text("pose-heading", pose ? `${((pose.heading_rad * 180) / Math.PI).toFixed(1)}°` : "–");
  const [xx, , yy] = pose?.covariance_m2 ?? [0, 0, 0];
  text("pose-sigma", pose ? `${(3000 * Math.sqrt(Math.max(xx, yy, 0))).toFixed(2)} mm` : "–");
}

function showLinks({ links, restarts }) {
  const list = $("links");
  while (list.children.length < links.length) {
    const row = document.createElement("li");
    row.append(document.createElement("b"), document.createElement("span"));
    list.append(row);
  }
  links.forEach((link, k) => {
    const row = list.children[k];
    const again = link.name === "main loop" ? restarts.main : link.name === "danger loop" ? restarts.danger : 0;
    row.dataset.well = link.is_well ? "yes" : "no";
    row.children[0].textContent = link.name;
    row.children[1].textContent = `${link.phase} ${age(link.age_s)}${again ? ` (restarted ${again}×)` : ""}`;
  });
}

function showLog(lines, isAll) {
  const list = $("log");
  if (isAll) {
    list.replaceChildren();
    rowOfKind.clear();
  }
  for (const [t, level, line, times, kind] of lines) {
    rowOfKind.get(kind)?.remove();
    const row = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = `${t.toFixed(1)} s`;
    const body = document.createElement("span");
    body.textContent = times > 1 ? `${line} (${times}×)` : line;
    row.dataset.level = level;
    row.append(time, body);
    list.prepend(row);
    rowOfKind.set(kind, row);
  }
  while (list.children.length > MAX_LINES) list.lastChild.remove();
}

// -- keys ---------------------------------------------------------------------------------------------------------

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return;
  const act = {
    p: () => commands.press("pause"),
    r: () => commands.press("resume"),
    a: () => commands.arm(),
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
