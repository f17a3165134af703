// Pause, resume, abort in two steps, stop: what is sent, and what the daemon answers.
const ARMED_MS = 5000;
// A double click is one wish, not two.
const SETTLE_MS = 350;
const NAMES = ["pause", "resume", "abort", "stop"];
const $ = (id) => document.getElementById(id);

export class Commands {
  constructor() {
    this.armedAt = null;
    this.timer = null;
    this.waiting = null;
    for (const name of ["pause", "resume", "stop"]) $(name).onclick = () => this.send(name);
    $("abort").onclick = () => (this.armedAt === null ? this.arm() : this.confirm());
    $("abort").addEventListener("blur", () => this.disarm());
    $("token").value = sessionStorage.getItem("ccatp-token") ?? "";
    $("token").onchange = () => sessionStorage.setItem("ccatp-token", $("token").value.trim());
  }

  // What makes sense now; while the link is lost abort and stop may still get through.
  receive({ mission, is_over }) {
    const state = mission?.state;
    const isOn = Boolean(mission) && !is_over;
    this.allow({
      pause: isOn && state !== "held",
      resume: isOn && state === "held",
      abort: isOn && state !== "returning",
      stop: isOn,
    });
  }

  end() {
    this.allow({});
  }

  allow(which) {
    for (const name of NAMES) $(name).disabled = !which[name] || this.waiting === name;
    if (!which.abort) this.disarm();
  }

  press(name) {
    if (!$(name).disabled) this.send(name);
  }

  arm() {
    const button = $("abort");
    if (button.disabled) return;
    this.armedAt = performance.now();
    button.classList.add("armed");
    button.textContent = "Confirm?";
    button.focus();
    this.say("Abort drives the robot home. Press again within 5 s to confirm.");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.disarm(), ARMED_MS);
  }

  confirm() {
    if (performance.now() - this.armedAt < SETTLE_MS) return;
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

  async send(name) {
    this.waiting = name;
    $(name).disabled = true;
    this.say(`${name} …`);
    try {
      const token = $("token").value.trim();
      const headers = token ? { authorization: `Bearer ${token}` } : {};
      const answer = await fetch(name, { method: "POST", headers });
      const { message } = await answer.json();
      this.say(answer.ok ? `${name}: done` : `refused: ${message}`, answer.ok ? "" : "bad");
      if (answer.status === 401) {
        $("token-row").hidden = false;
        $("token").focus();
      }
    } catch {
      this.say(`${name}: the dashboard did not answer`, "bad");
    }
    this.waiting = null;
  }

  say(words, level = "") {
    $("answer").textContent = words;
    $("answer").dataset.level = level;
  }
}
