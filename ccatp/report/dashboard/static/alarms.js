// The list of alarms, its announcements, and the emergencies, which are reported and cleared after a confirmation.
const SEVERITIES = ["", "inform", "slow", "pause", "hold", "return", "fault"];
const LEVELS = ["", "note", "warn", "warn", "bad", "bad", "bad"];
// Whatever else there is, these decide what the robot does (docs/operator.md).
const EFFECTS = {
  earthquake: "the wheels are held until it is cleared, then the robot drives home",
  fire: "the robot drives home",
  power: "the robot drives home",
  weather: "the robot drives home",
  operator: "the robot drives home",
};
const $ = (id) => document.getElementById(id);
const node = (kind, words, name = "") => Object.assign(document.createElement(kind), { textContent: words, className: name });
const isGrave = (alarm) => SEVERITIES.indexOf(alarm.severity) >= SEVERITIES.indexOf("hold");
const time = (utc) => utc.slice(11);

export const severity = (level) => SEVERITIES[level] ?? "";

export class Alarms {
  constructor(commands) {
    this.commands = commands;
    this.known = new Set();
    this.tones = null;
    this.chosen = null;
    this.emergencies = [];
    // If the operator turned it on: a tone and a browser notification for each new severe alarm.
    $("sound").onchange = () => {
      this.tones = $("sound").checked ? new AudioContext() : null;
      if (this.tones && "Notification" in window) Notification.requestPermission();
    };
    $("emergency").onclick = () => this.ask();
    $("raise").onclose = () => {
      if ($("raise").returnValue === "raise" && this.chosen) commands.emergency(this.chosen, $("note").value);
    };
    $("clear").onclose = () => {
      if ($("clear").returnValue === "clear") commands.clear(this.chosen);
    };
  }

  begin({ emergency_kinds }) {
    const fields = emergency_kinds.map((kind) => {
      const label = node("label", "");
      const choice = Object.assign(document.createElement("input"), { type: "radio", name: "kind", value: kind });
      choice.onchange = () => {
        this.chosen = kind;
        $("raise-confirm").disabled = false;
        $("raise-confirm").textContent = `Report ${kind}`;
      };
      label.append(choice, ` ${kind}: ${EFFECTS[kind] ?? ""}`);
      return label;
    });
    $("kinds").replaceChildren($("kinds").firstElementChild, ...fields);
  }

  // Nothing is chosen beforehand.
  ask() {
    this.chosen = null;
    for (const choice of $("kinds").querySelectorAll("input")) choice.checked = false;
    $("note").value = "";
    $("raise-confirm").disabled = true;
    $("raise-confirm").textContent = "Report";
    $("raise").returnValue = "";
    $("raise").showModal();
  }

  askToClear({ kind, id, note }) {
    this.chosen = id;
    $("clear-what").textContent = `${kind}${note ? `: ${note}` : ""}, ${id}`;
    $("clear").returnValue = "";
    $("clear").showModal();
  }

  // The first emergency that is latched, from the button of the next action.
  clearFirst() {
    if (this.emergencies.length) this.askToClear(this.emergencies[0]);
  }

  receive({ alarms, emergencies, is_over, mission }, isAll) {
    this.emergencies = emergencies;
    const canClear = !is_over && (mission?.turn.offers ?? []).includes("clear");
    const title = is_over ? "Alarms active at the end" : "Alarms";
    if ($("alarms-head").textContent !== title) $("alarms-head").textContent = title;
    this.announce(alarms, isAll);
    $("alarms-card").hidden = alarms.length + emergencies.length === 0;
    // An emergency is shown in its alarm; without one, as after the end of a daemon, it has a row of its own.
    const shown = emergencies.map((emergency) => ({ ...emergency, canClear }));
    const of = (alarm) => (alarm.ended ? [] : shown.filter((emergency) => emergency.alarm === alarm.name));
    const listed = new Set(alarms.flatMap(of));
    fill($("emergencies"), shown.filter((emergency) => !listed.has(emergency)), (emergency) => {
      const row = node("li", "");
      row.dataset.level = "bad";
      const head = node("span", "");
      head.append(node("b", "■ emergency"), node("strong", `${emergency.kind}${emergency.note ? `: ${emergency.note}` : ""}`));
      row.title = emergency.id;
      row.append(head, ...this.clearButton(emergency));
      return row;
    });
    fill($("alarms"), alarms.map((alarm) => ({ ...alarm, isOver: is_over, emergencies: of(alarm) })), (alarm) => this.row(alarm));
  }

  clearButton(emergency) {
    if (!emergency.canClear) return [];
    const button = node("button", "Clear …");
    button.onclick = () => this.askToClear(emergency);
    return [button];
  }

  row(alarm) {
    const row = node("li", "");
    row.dataset.level = alarm.ended ? "" : LEVELS[SEVERITIES.indexOf(alarm.severity)];
    const head = node("span", "");
    const sign = alarm.ended ? "–" : { bad: "■", warn: "▲" }[row.dataset.level] ?? "●";
    head.append(node("b", `${sign} ${alarm.severity}`), node("strong", alarm.cause));
    const times = alarm.count > 1 ? `, ${alarm.count} times` : "";
    const by = alarm.acknowledged_by ? `, acknowledged by ${alarm.acknowledged_by}, ${time(alarm.acknowledged)}` : "";
    const ended = alarm.ended ? `, ended ${time(alarm.ended)}` : "";
    head.append(node("small", ` since ${time(alarm.since)}${times}${ended}${by}`));
    row.append(head, node("p", alarm.advice));
    for (const emergency of alarm.emergencies) {
      const line = node("p", `${emergency.kind}${emergency.note ? `: ${emergency.note}` : ""} `, "emergency");
      line.title = emergency.id;
      line.append(...this.clearButton(emergency));
      row.append(line);
    }
    if (!alarm.acknowledged_by && !alarm.isOver) {
      const button = node("button", "Acknowledge", "acknowledge");
      button.onclick = () => this.commands.acknowledge(alarm.name);
      row.append(button);
    }
    return row;
  }

  announce(alarms, isAll) {
    const keyOf = (alarm) => `${alarm.name} ${alarm.count} ${alarm.severity}`;
    const grave = alarms.filter((alarm) => !alarm.ended && isGrave(alarm));
    const fresh = grave.filter((alarm) => !this.known.has(keyOf(alarm)));
    this.known = new Set(grave.map(keyOf));
    if (isAll || !this.tones || !fresh.length) return;
    const tone = this.tones.createOscillator();
    tone.frequency.value = 880;
    tone.connect(this.tones.destination);
    tone.start();
    tone.stop(this.tones.currentTime + 0.6);
    if ("Notification" in window && Notification.permission === "granted")
      new Notification(document.title, { body: fresh.map((alarm) => `${alarm.cause}. ${alarm.advice}`).join(" ") });
  }
}

// A row is replaced only if it has changed: a button must not move while it is pressed.
function fill(list, items, rowOf) {
  items.forEach((item, k) => {
    const key = JSON.stringify(item);
    if (list.children[k]?.dataset.key === key) return;
    const row = rowOf(item);
    row.dataset.key = key;
    if (list.children[k]) list.children[k].replaceWith(row);
    else list.append(row);
  });
  while (list.children.length > items.length) list.lastChild.remove();
}
