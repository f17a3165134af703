// Errors and innovations over the robot's time.
const MAX_ROWS = 4000;
const REDRAW_MS = 400;
const HEIGHT = 165;
// Whole seconds, as the labels have no more.
const TIME_STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600];
const minutes = (s) => {
  const all = Math.round(s);
  return `${Math.floor(all / 60)}:${String(Math.abs(all % 60)).padStart(2, "0")}`;
};

// Columns of each plot behind the time: label, colour, how it is drawn.
const LOOKS = {
  arrival: [{ label: "arrival error", ink: "--accent", dots: true }],
  error: [
    { label: "true error", ink: "--accent" },
    { label: "3σ", ink: "--warn", dash: [5, 4] },
  ],
  jump: [{ label: "jump", ink: "--good", dots: true }],
  map: [
    { label: "true error", ink: "--accent" },
    { label: "expected", ink: "--warn", dash: [5, 4] },
  ],
  nis: [{ label: "NIS / dof", ink: "--path", dots: true }],
  target: [
    { label: "distance", ink: "--accent" },
    { label: "to be kept", ink: "--warn", dash: [5, 4] },
  ],
  clearance: [{ label: "nearest", ink: "--accent" }],
};
// Rows as they are sent into rows as they are drawn.
const SHAPE = { nis: ([t, nis, size]) => [t, nis / size] };

export class Plots {
  constructor(placeOf) {
    this.placeOf = placeOf;
    this.names = [];
    this.rows = {};
    this.places = {};
    this.plots = {};
    this.dirty = new Set();
    this.drawnAt = 0;
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.build());
    this.observer = new ResizeObserver(() => this.resize());
  }

  // Which of them this mission has; they may be others when the next one begins at the same place.
  begin(names) {
    if (names.join() === this.names.join()) return;
    for (const name of this.names) {
      this.plots[name].destroy();
      this.places[name].closest("figure").hidden = true;
    }
    this.names = names;
    this.rows = Object.fromEntries(names.map((name) => [name, []]));
    this.places = Object.fromEntries(names.map((name) => [name, this.placeOf(name)]));
    this.plots = {};
    this.observer.disconnect();
    for (const name of names) this.places[name].closest("figure").hidden = false;
    this.build();
    this.observer.observe(this.places[names[0]]);
  }

  build() {
    const style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(name).trim();
    for (const name of this.names) {
      const columns = LOOKS[name];
      this.plots[name]?.destroy();
      const axis = { stroke: ink("--quiet"), grid: { stroke: ink("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
      this.plots[name] = new uPlot(
        {
          width: Math.max(this.places[name].clientWidth, 120),
          height: HEIGHT,
          scales: { x: { time: false }, y: { range: (_, low, high) => range(low, high) } },
          axes: [
            { ...axis, values: (_, at) => at.map(minutes), space: 60, incrs: TIME_STEPS_S },
            { ...axis, size: 46 },
          ],
          legend: { show: false },
          cursor: { drag: { x: true, y: false }, points: { show: false } },
          series: [
            {},
            ...columns.map(({ label, ink: colour, dash, dots }) => ({
              label,
              stroke: ink(colour),
              width: dots ? 0 : 1.5,
              dash,
              spanGaps: true,
              points: { show: Boolean(dots), size: 4, fill: ink(colour), stroke: ink(colour) },
            })),
          ],
        },
        this.columns(name),
        this.places[name],
      );
      this.places[name].setAttribute("role", "img");
      this.describe(name);
    }
  }

  receive(series, isAll) {
    for (const name of this.names) {
      const news = (series[name] ?? []).map(SHAPE[name] ?? ((row) => row));
      if (isAll) this.rows[name] = news;
      else if (news.length) this.rows[name].push(...news);
      if (this.rows[name].length > MAX_ROWS) this.rows[name].splice(0, this.rows[name].length - MAX_ROWS);
      if (isAll || news.length) this.dirty.add(name);
    }
    const now = performance.now();
    if (!this.dirty.size || (now - this.drawnAt < REDRAW_MS && !isAll)) return;
    this.drawnAt = now;
    for (const name of this.dirty) {
      this.plots[name].setData(this.columns(name));
      this.describe(name);
    }
    this.dirty.clear();
  }

  columns(name) {
    const rows = this.rows[name];
    return [0, ...LOOKS[name].map((_, k) => k + 1)].map((k) => rows.map((row) => row[k] ?? null));
  }

  describe(name) {
    const last = this.rows[name].at(-1);
    this.places[name].toggleAttribute("data-empty", !last);
    const words = LOOKS[name].map(({ label }, k) => (last?.[k + 1] == null ? "" : `${label} ${last[k + 1].toFixed(3)}`));
    this.places[name].setAttribute("aria-label", last ? `${this.rows[name].length} values, latest ${words.filter(Boolean).join(", ")}` : "no values yet");
  }

  resize() {
    for (const [name, plot] of Object.entries(this.plots)) {
      const width = Math.max(this.places[name].clientWidth, 120);
      if (Math.abs(width - plot.width) > 1) plot.setSize({ width, height: HEIGHT });
    }
  }
}

// From zero, with room above; one flat line is seen as well.
function range(low, high) {
  if (low === null || high === null) return [0, 1];
  return [Math.min(0, low), (high || 1) * 1.1];
}
