// Commands and the daemon's answers: pause, resume, abort in two steps, stop. All of them need a token.
const ARMED_MS = 5000;
// A double click is one command: as the browser counts clicks, and, of two devices, by the times when they were pressed.
const SETTLE_MS = 350;
const NAMES = ["pause", "resume", "abort", "stop", "emergency"];
const KEPT = "ccatp-token";
const $ = (id) => document.getElementById(id);

export class Commands {
  constructor() {
    this.armedAt = null;
    this.timer = null;
    this.waiting = null;
    this.sensible = {};
    this.offers = [];
    for (const name of ["pause", "resume", "stop"]) $(name).onclick = () => this.send(name);
    $("abort").onclick = (event) => (this.armedAt === null ? this.arm(event.timeStamp) : this.confirm(event));
    $("abort").addEventListener("blur", () => this.disarm());
    $("token").onchange = () => this.keep($("token").value.trim());
    const given = new URLSearchParams(location.search).get("token");
    if (given) history.replaceState(null, "", location.pathname); // neither in a bookmark nor on a screen
    this.keep(given ?? sessionStorage.getItem(KEPT) ?? "");
  }

  keep(token) {
    this.token = token;
    sessionStorage.setItem(KEPT, token);
    $("token").value = token;
    $("read-only").hidden = Boolean(token);
    this.allow(this.sensible);
    this.nameOperator();
  }

  async nameOperator() {
    let name = "read-only";
    if (this.token) {
      try {
        const answer = await fetch("operator", { headers: { authorization: `Bearer ${this.token}` } });
        if (answer.ok) ({ name } = await answer.json());
      } catch {
        name = "not known";
      }
    }
    $("operator").textContent = name;
  }

  // What the daemon would accept now, by its own word; an emergency may always be reported while it runs.
  receive({ mission, is_over }) {
    const isOn = Boolean(mission) && !is_over;
    const offers = isOn ? (mission.turn.offers ?? []) : [];
    this.offers = offers;
    this.allow({ ...Object.fromEntries(["pause", "resume", "abort", "stop"].map((name) => [name, offers.includes(name)])), emergency: isOn });
  }

  end() {
    this.offers = [];
    this.allow({});
  }

  allow(which) {
    this.sensible = which;
    for (const name of NAMES) $(name).disabled = !this.token || !which[name] || this.waiting === name;
    if ($("abort").disabled) this.disarm();
  }

  press(name) {
    if (!$(name).disabled) this.send(name);
  }

  // ``at``: when it was pressed, by the event; a busy page handles it later.
  arm(at) {
    const button = $("abort");
    if (button.disabled) return;
    this.armedAt = at;
    button.classList.add("armed");
    button.textContent = "Confirm?";
    button.focus();
    this.say("Abort drives the robot home. Press again within 5 s to confirm.");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.disarm(), ARMED_MS);
  }

  confirm({ detail, timeStamp }) {
    if (detail > 1 || timeStamp - this.armedAt < SETTLE_MS) return;
    this.disarm();
    this.send("abort");
  }

  disarm() {
    if (this.armedAt === null) return;
    clearTimeout(this.timer);
    this.armedAt = null;
    $("abort").classList.remove("armed");
    $("abort").textContent = "Abort";
    this.say("");
  }

  // Without a token the daemon refuses these with a reason.
  acknowledge(alarm) {
    this.post("alarms/ack", `acknowledge ${alarm}`, { name: alarm });
  }

  emergency(kind, note) {
    this.post("emergency", `emergency ${kind}`, { kind, note });
  }

  clear(id) {
    this.post("clear", "clear", { id });
  }

  async send(name) {
    this.waiting = name;
    $(name).disabled = true;
    await this.post(name, name);
    this.waiting = null;
  }

  async post(path, name, body) {
    this.say(`${name} …`);
    try {
      const headers = { authorization: `Bearer ${this.token}` };
      const answer = await fetch(path, { method: "POST", headers, body: body && JSON.stringify(body) });
      const { message } = await answer.json();
      this.say(answer.ok ? `${name}: done` : `refused: ${message}`, answer.ok ? "" : "bad");
      if (answer.status === 401) this.keep(""); // of an earlier start
    } catch {
      this.say(`${name}: the dashboard did not answer`, "bad");
    }
  }

  say(words, level = "") {
    $("answer").textContent = words;
    $("answer").dataset.level = level;
  }
}
