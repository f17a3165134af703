// Errors and innovations over the time of the mission. Drag zooms all plots to a time, a double click shows all of it.
import { Rows } from "./history.js";

const MAX_ROWS = 4000;
const REDRAW_MS = 400;
const LEAST_HEIGHT = 90;
const LEAST_VALUE = 1e-3; // a logarithm has no zero
const NEAR = 1000; // a limit that is further away than so many times the largest value is not drawn
const TIME_STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800];
const KEPT = "ccatp-engineer";
const two = (n) => String(n).padStart(2, "0");
const time = (s) => {
  const all = Math.max(Math.round(s), 0);
  const [h, m] = [Math.floor(all / 3600), Math.floor(all / 60) % 60];
  return h ? `${h}:${two(m)} h` : `${m}:${two(all % 60)} min`;
};
const short = (value) => (value == null ? "–" : String(Number(value.toPrecision(3))));

// For each plot: unit, whether it is logarithmic, and its columns with label, colour, style.
const LOOKS = {
  arrival: { unit: "mm", isLog: true, columns: [{ label: "by the laser", ink: "--ink", isDots: true }] },
  error: {
    unit: "mm",
    isLog: true,
    columns: [
      { label: "true (simulation)", ink: "--sim" },
      { label: "3σ estimated", ink: "--estimate", isBand: true },
    ],
  },
  jump: { unit: "mm", isLog: true, columns: [{ label: "moved by the fix", ink: "--ink", isDots: true }] },
  map: {
    unit: "mm",
    isLog: true,
    columns: [
      { label: "true (simulation)", ink: "--sim" },
      { label: "expected", ink: "--estimate", isBand: true },
    ],
  },
  nis: { unit: "per dof", isLog: true, columns: [{ label: "NIS", ink: "--estimate", isDots: true }] },
  target: {
    unit: "m",
    columns: [
      { label: "distance", ink: "--estimate" },
      { label: "to be kept", ink: "--warn", dash: [5, 4] },
    ],
  },
  clearance: { unit: "m", columns: [{ label: "nearest", ink: "--ink" }] },
};
// Converts sent rows to drawn rows.
const SHAPE = { nis: ([t, nis, size]) => [t, nis === null ? null : nis / size] };

export class Plots {
  constructor(placeOf, allButton, engineerBox, emptyNote) {
    this.placeOf = placeOf;
    this.names = [];
    this.lines = {};
    this.history = {};
    this.places = {};
    this.plots = {};
    this.dirty = new Set();
    this.drawnAt = 0;
    this.window = null; // the time that is zoomed to
    this.allButton = allButton;
    allButton.onclick = () => this.zoom(null);
    this.engineerBox = engineerBox;
    this.emptyNote = emptyNote;
    engineerBox.checked = localStorage.getItem(KEPT) === "yes";
    engineerBox.onchange = () => {
      localStorage.setItem(KEPT, engineerBox.checked ? "yes" : "no");
      this.showFigures();
    };
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.build());
    this.observer = new ResizeObserver(() => this.resize());
  }

  // Which of them this mission has, and their limits; they may be others when the next one begins at the same place.
  begin(lines) {
    const names = Object.keys(lines);
    if (JSON.stringify(lines) === JSON.stringify(this.lines)) return;
    for (const name of this.names) {
      this.plots[name].destroy();
      this.places[name].closest("figure").hidden = true;
    }
    this.lines = lines;
    this.names = names;
    this.history = Object.fromEntries(names.map((name) => [name, new Rows(MAX_ROWS)]));
    this.places = Object.fromEntries(names.map((name) => [name, this.placeOf(name)]));
    this.plots = {};
    this.observer.disconnect();
    this.showFigures();
    this.build();
    for (const name of names) this.observer.observe(this.places[name]);
  }

  // An empty plot takes no room, and those for engineers are shown when they are wanted.
  showFigures() {
    const figures = this.names.map((name) => [name, this.places[name].closest("figure")]);
    const isFor = (figure) => this.engineerBox.checked || !("engineer" in figure.dataset);
    for (const [name, figure] of figures) figure.hidden = !this.history[name].rows.length || !isFor(figure);
    this.engineerBox.closest("label").hidden = !figures.some(([, figure]) => "engineer" in figure.dataset);
    this.emptyNote.hidden = figures.some(([, figure]) => !figure.hidden);
  }

  build() {
    const style = getComputedStyle(document.documentElement);
    this.ink = (name) => style.getPropertyValue(name).trim();
    for (const name of this.names) {
      const { columns } = LOOKS[name];
      const place = this.places[name];
      this.plots[name]?.destroy();
      this.plots[name] = new uPlot(this.options(name), this.columns(name), place);
      place.setAttribute("role", "img");
      const caption = place.closest("figure").querySelector("figcaption");
      caption.querySelector(".key")?.remove();
      const key = document.createElement("span");
      key.className = "key";
      for (const column of columns) {
        const item = document.createElement("span");
        const mark = document.createElement("i");
        mark.textContent = column.isDots ? "●" : column.isBand ? "▆" : column.dash ? "╌" : "━";
        mark.style.color = this.ink(column.ink);
        item.append(mark, document.createElement("b"));
        key.append(item);
      }
      caption.append(key);
      this.describe(name);
    }
  }

  options(name) {
    const { unit, isLog, columns } = LOOKS[name];
    const axis = { stroke: this.ink("--quiet"), grid: { stroke: this.ink("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    return {
      ...this.sizeOf(name),
      scales: {
        x: { time: false, range: () => this.window ?? this.span() },
        y: { distr: isLog ? 3 : 1, range: (_, low, high) => (isLog ? this.decades(name, low, high) : range(low, high)) },
      },
      axes: [
        { ...axis, values: (_, at) => at.map(time), space: 75, incrs: TIME_STEPS_S, size: 24, gap: 3 },
        { ...axis, size: 44, gap: 3, label: unit, labelSize: 14, labelGap: 0, labelFont: "11px system-ui", ...(isLog ? { splits: ({ scales }) => decades(scales.y) } : {}), values: (_, at) => at.map((value) => (value === null ? "" : short(value))) },
      ],
      padding: [6, 28, 0, 0],
      legend: { show: false },
      cursor: {
        drag: { x: true, y: false, setScale: false },
        points: { show: false },
        y: false,
        bind: { dblclick: () => () => this.zoom(null) },
      },
      hooks: {
        setSelect: [({ select, posToVal }) => select.width > 4 && this.zoom([select.left, select.left + select.width].map((at) => posToVal(at, "x")))],
        setCursor: [({ cursor }) => this.describe(name, cursor.idx)],
        draw: [(plot) => this.drawLines(plot, name)],
      },
      series: [
        {},
        ...columns.map(({ label, ink, dash, isDots, isBand }) => ({
          label,
          stroke: this.ink(ink),
          width: isDots ? 0 : 1.5,
          dash,
          fill: isBand ? `color-mix(in srgb, ${this.ink(ink)} 18%, transparent)` : undefined,
          spanGaps: false,
          points: { show: isDots ? true : (plot, column, from, to) => to - from < 3, size: 4, width: 0, fill: this.ink(ink), stroke: this.ink(ink) },
        })),
      ],
    };
  }

  // Limits and expected values, each with its label.
  drawLines({ ctx, bbox, scales, valToPos }, name) {
    const ratio = devicePixelRatio || 1;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = this.ink("--warn");
    ctx.lineWidth = ratio;
    ctx.setLineDash([6 * ratio, 4 * ratio]);
    ctx.font = `${10 * ratio}px system-ui`;
    for (const [k, [value, words]] of this.lines[name].entries()) {
      if (value < scales.y.min || value > scales.y.max) continue;
      const y = Math.round(valToPos(value, "y", true));
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      ctx.textAlign = k % 2 ? "right" : "left"; // beside each other where two are near
      const x = k % 2 ? bbox.left + bbox.width - 2 * ratio : bbox.left + 4 * ratio;
      const unit = LOOKS[name].unit === "mm" ? " mm" : "";
      const isHigh = y - bbox.top < 14 * ratio;
      ctx.textBaseline = isHigh ? "top" : "bottom";
      ctx.fillText(`${words} ${short(value)}${unit}`, x, isHigh ? y + 2 * ratio : y - 2 * ratio);
    }
    ctx.restore();
  }

  zoom(window) {
    this.window = window && window[1] > window[0] ? window : null;
    this.allButton.hidden = !this.window;
    for (const name of this.names) {
      this.plots[name].setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      this.draw(name);
    }
  }

  // All plots show the same time.
  span() {
    const known = this.names.map((name) => this.history[name].rows).filter((rows) => rows.length);
    if (!known.length) return [0, 60];
    const [low, high] = [Math.min(...known.map((rows) => rows[0][0])), Math.max(...known.map((rows) => rows.at(-1)[0]))];
    return [low, Math.max(high, low + 10)];
  }

  decades(name, low, high) {
    const known = low === null || high === null ? [] : [low, high];
    const near = this.lines[name].map(([value]) => value).filter((value) => !known.length || value < NEAR * high);
    const all = [...known, ...near];
    if (!all.length) return [0.01, 10];
    const [from, to] = [Math.floor(Math.log10(Math.min(...all)) + 1e-9), Math.ceil(Math.log10(1.2 * Math.max(...all)))];
    return [10 ** from, 10 ** Math.max(to, from + 1)];
  }

  receive(series, isAll) {
    for (const name of this.names) {
      const news = (series[name] ?? []).map(SHAPE[name] ?? ((row) => row));
      this.history[name].receive(news, isAll);
      if (isAll || news.length) this.dirty.add(name);
    }
    const now = performance.now();
    if (!this.dirty.size || (now - this.drawnAt < REDRAW_MS && !isAll)) return;
    this.drawnAt = now;
    this.showFigures();
    for (const name of this.names) this.draw(name); // the others show the same time
    this.dirty.clear();
  }

  draw(name) {
    this.plots[name].setData(this.columns(name));
    this.describe(name);
  }

  columns(name) {
    const { rows } = this.history[name];
    const { isLog, columns } = LOOKS[name];
    const shown = (value) => (value == null ? null : isLog ? Math.max(value, LEAST_VALUE) : value);
    return [rows.map(([t]) => t), ...columns.map((_, k) => rows.map((row) => shown(row[k + 1])))];
  }

  // Values under the pointer, or else the latest.
  describe(name, index = null) {
    const { rows } = this.history[name];
    const { columns, unit } = LOOKS[name];
    const row = (index === null ? null : rows[index]) ?? rows.at(-1);
    const place = this.places[name];
    const keys = place.closest("figure").querySelectorAll(".key b");
    const suffix = ` ${unit}`;
    columns.forEach(({ label }, k) => {
      const words = row?.[k + 1] == null ? label : `${label} ${short(row[k + 1])}${suffix}`;
      if (keys[k] && keys[k].textContent !== words) keys[k].textContent = words;
    });
    const last = columns.map(({ label }, k) => (rows.at(-1)?.[k + 1] == null ? "" : `${label} ${rows.at(-1)[k + 1].toFixed(3)}`));
    place.setAttribute("aria-label", rows.length ? `${rows.length} values, latest ${last.filter(Boolean).join(", ")}` : "no values yet");
  }

  sizeOf(name) {
    const place = this.places[name];
    return { width: Math.max(place.clientWidth, 120), height: Math.max(place.clientHeight, LEAST_HEIGHT) };
  }

  resize() {
    for (const [name, plot] of Object.entries(this.plots)) {
      const { width, height } = this.sizeOf(name);
      if (Math.abs(width - plot.width) > 1 || Math.abs(height - plot.height) > 1) plot.setSize({ width, height });
    }
  }
}

function decades({ min, max }) {
  const [from, to] = [min, max].map((value) => Math.round(Math.log10(value)));
  const step = Math.ceil((to - from) / 4); // more labels do not fit
  return Array.from({ length: to - from + 1 }, (_, k) => 10 ** (to - k)).filter((_, k) => k % step === 0).reverse();
}

// From zero, with a margin above, so that a constant line is visible.
function range(low, high) {
  if (low === null || high === null) return [0, 1];
  return [Math.min(0, low), (high || 1) * 1.1];
}
