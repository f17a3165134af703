// The map: panels, points, path, robot, and further objects of the mission. Metres, x to the right, y up.
import { Rows } from "./history.js";

const PLANNED = 0, ARRIVED = 1, MEASURED = 2, SKIPPED = 3;
const MARGIN = 0.25;
const BEYOND = 1.5; // metres outside of the rim that are still shown
const ZOOM = [0.5, 400];
const NEXT = 4;
const MAX_PATH = 12000;
// Magnifications of the three sigma ellipse: the operator chooses one, and the legend shows it.
const MAGNIFIED = [100, 1000, 1];
const KEPT = "ccatp-ellipse";
// A panel of at least this half width has room for its number between its points.
const NUMBER_PX = 20;
const INKS = ["ink", "quiet", "card", "line", "panel", "seam", "rim", "good", "note", "warn", "bad", "sim", "estimate", "todo"];

// How things look: each gets the pen (with its colours), the place in pixels, the size of a metre, and the thing.
const LOOKS = {
  landmark: (pen, x, y) => polygon(pen, [[x, y - 8], [x + 7, y + 5], [x - 7, y + 5]], pen.inks.estimate),
  target: (pen, x, y) => polygon(pen, [[x, y - 7], [x + 7, y], [x, y + 7], [x - 7, y]], pen.inks.note),
  robot: (pen, x, y) => disc(pen, x, y, 6, pen.inks.ink),
  obstacle: (pen, x, y, scale, shape) => {
    if (!shape.outline_m && !shape.radius_m) disc(pen, x, y, 5, pen.inks.quiet);
  },
  trail: () => {},
  true: (pen, x, y) => cross(pen, x, y, pen.inks.sim), // where it really is: in simulation alone
};
const FILLED = { obstacle: "seam" };

export class MapView {
  constructor(canvas, legend, ellipseButton, fitButton) {
    this.fitButton = fitButton;
    this.canvas = canvas;
    this.legend = legend;
    const kept = Number(localStorage.getItem(KEPT));
    this.chosen = MAGNIFIED.includes(kept) ? kept : MAGNIFIED[0];
    this.ellipseButton = ellipseButton;
    ellipseButton.onclick = () => this.magnify();
    this.context = canvas.getContext("2d");
    this.ground = { panels: [], rim: [], points: [], base: null, edge_sensors_m: [], arrival_tolerance_mm: 10 };
    this.clear();
    this.scale = null; // pixels a metre; null: all of it
    this.centre = [0, 0];
    this.isFollowing = false;
    this.isWhole = false; // the whole mirror, not only the planned points
    this.isDue = false;
    this.readInks();
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.readInks());
    new ResizeObserver(() => this.draw()).observe(canvas);
    this.listen();
  }

  clear() {
    this.states = [];
    this.errors = [];
    this.path = new Rows(MAX_PATH);
    this.shapes = [];
    this.pose = this.mission = this.robot = null;
  }

  readInks() {
    const style = getComputedStyle(document.documentElement);
    this.inks = Object.fromEntries(INKS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    this.draw();
  }

  begin(ground) {
    this.ground = ground;
    this.showLegend();
    this.byName = new Map(ground.points.map(([name], k) => [name, k]));
    this.clear();
    this.draw();
  }

  receive(state, isAll) {
    if (isAll) this.clear();
    for (const [k, how, error] of state.points) {
      this.states[k] = how;
      this.errors[k] = error;
    }
    this.path.receive(state.path, isAll);
    if (state.shapes) this.shapes = state.shapes;
    this.pose = state.pose;
    this.mission = state.mission;
    this.robot = state.robot;
    this.isLost = state.losses.length > 0;
    this.describe();
    this.draw();
  }

  magnify() {
    this.chosen = MAGNIFIED[(MAGNIFIED.indexOf(this.chosen) + 1) % MAGNIFIED.length];
    localStorage.setItem(KEPT, this.chosen);
    this.showLegend();
    this.draw();
  }

  // In a room without panels the ellipses are as large as the room.
  get magnified() {
    return this.ground.panels.length ? this.chosen : 1;
  }

  showLegend() {
    this.ellipseButton.hidden = !this.ground.panels.length;
    this.ellipseButton.textContent = `3σ ×${this.magnified}`;
    const tolerance = `${this.ground.arrival_tolerance_mm} mm`;
    const ofSurvey = [["○", "todo", "planned"], ["●", "good", `within ${tolerance}`], ["▲", "warn", `beyond ${tolerance}`], ["✕", "warn", "not measured"]];
    const items = [
      ...(this.ground.legend ?? ofSurvey),
      ["◎", "note", "next"],
      ["━", "estimate", "driven path"],
      ["◯", "estimate", `3σ ellipse × ${this.magnified}`],
    ];
    this.legend.replaceChildren(...items.map(([sign, ink, words]) => {
      const item = document.createElement("span");
      const mark = document.createElement("i");
      mark.textContent = sign;
      mark.style.color = `var(--${ink})`;
      item.append(mark, words);
      return item;
    }));
  }

  describe() {
    const measured = this.states.filter((how) => how === MEASURED).length;
    const where = this.pose ? `robot at ${this.pose.x_m.toFixed(2)}, ${this.pose.y_m.toFixed(2)} m` : "robot not known";
    const other = this.shapes.length ? `, ${this.shapes.length} other things` : "";
    const { goal, reached } = this.ground.words ?? {};
    const goals = this.ground.points.length ? `, ${measured} of ${this.ground.points.length} ${goal} ${reached}` : "";
    const words = `Map: ${where}${goals}${other}`;
    if (this.canvas.getAttribute("aria-label") !== words) this.canvas.setAttribute("aria-label", words);
  }

  // -- the view -----------------------------------------------------------------------------------------------------

  bounds() {
    const { rim, points, base } = this.ground;
    if (rim.length && points.length && !this.isWhole) {
      const places = [...points.map((p) => p.slice(1)), ...(base ? [base] : [])];
      const [xs, ys] = [places.map((p) => p[0]), places.map((p) => p[1])];
      return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    }
    const all = rim.length ? [...rim, ...this.around(rim)] : [...points.map((p) => p.slice(1)), ...this.path.rows.filter((p) => p[1] !== null).map((p) => p.slice(1)), ...this.shapes.map((s) => [s.x_m, s.y_m]), ...this.shapes.flatMap((s) => s.outline_m ?? [])];
    if (!rim.length && this.pose) all.push([this.pose.x_m, this.pose.y_m]);
    if (!all.length) return base ? [base[0] - 1, base[1] - 1, base[0] + 1, base[1] + 1] : [-1, -1, 1, 1];
    const xs = all.map((p) => p[0]), ys = all.map((p) => p[1]);
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }

  // Objects up to BEYOND outside the rim; distant ones are left out, because a first estimate may be anywhere.
  around(rim) {
    const xs = rim.map((p) => p[0]), ys = rim.map((p) => p[1]);
    const [x0, x1, y0, y1] = [Math.min(...xs) - BEYOND, Math.max(...xs) + BEYOND, Math.min(...ys) - BEYOND, Math.max(...ys) + BEYOND];
    return this.shapes.map((s) => [s.x_m, s.y_m]).filter(([x, y]) => x >= x0 && x <= x1 && y >= y0 && y <= y1);
  }

  view() {
    const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const [x0, y0, x1, y1] = this.bounds();
    const whole = Math.min(w / (x1 - x0 + 2 * MARGIN), h / (y1 - y0 + 2 * MARGIN));
    const scale = this.scale ?? whole;
    let [cx, cy] = this.scale === null ? [(x0 + x1) / 2, (y0 + y1) / 2] : this.centre;
    if (this.isFollowing && this.pose) [cx, cy] = this.centre = [this.pose.x_m, this.pose.y_m];
    return { w, h, scale, whole, at: (x, y) => [w / 2 + (x - cx) * scale, h / 2 - (y - cy) * scale], cx, cy };
  }

  zoom(factor, px = null, py = null) {
    const { w, h, scale, whole, cx, cy } = this.view();
    const next = Math.min(Math.max(scale * factor, whole * ZOOM[0]), ZOOM[1] * whole);
    if (next <= whole) return this.fit();
    const [dx, dy] = px === null ? [0, 0] : [px - w / 2, py - h / 2];
    const [from, to] = [1 / scale, 1 / next];
    this.centre = this.scale === null && px === null && this.pose ? [this.pose.x_m, this.pose.y_m] : [cx + dx * (from - to), cy - dy * (from - to)];
    this.scale = next;
    this.canvas.style.touchAction = "none";
    this.draw();
    return undefined;
  }

  pan(dx, dy) {
    if (this.scale === null) return;
    this.isFollowing = false;
    this.showFollow();
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  // All of the planned points; pressed again, the whole mirror, and back.
  fit() {
    const isFitted = this.scale === null && !this.isFollowing;
    if (isFitted) this.isWhole = !this.isWhole;
    this.fitButton.textContent = this.isWhole ? "Points" : "All";
    this.fitButton.setAttribute("aria-label", this.isWhole ? "Planned points" : "Whole mirror");
    this.fitButton.title = `${this.isWhole ? "Planned points" : "Whole mirror"} (0)`;
    this.scale = null;
    this.isFollowing = false;
    this.canvas.style.touchAction = "pan-y";
    this.showFollow();
    this.draw();
  }

  toggleFollow() {
    this.isFollowing = !this.isFollowing;
    if (this.isFollowing && this.scale === null) this.scale = this.view().whole * 6;
    this.canvas.style.touchAction = this.scale === null ? "pan-y" : "none";
    this.showFollow();
    this.draw();
  }

  showFollow() {
    document.getElementById("follow").setAttribute("aria-pressed", String(this.isFollowing));
  }

  listen() {
    const { canvas } = this;
    const fingers = new Map();
    canvas.style.touchAction = "pan-y";
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.offsetX, event.offsetY];
      const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
      fingers.set(event.pointerId, now);
      if (other) {
        const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
        this.zoom(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else {
        this.pan(now[0] - before[0], now[1] - before[1]);
      }
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[event.key];
      if (!step) return;
      event.preventDefault();
      this.pan(...step);
    });
  }

  // -- drawing ------------------------------------------------------------------------------------------------------

  draw() {
    if (this.isDue) return;
    this.isDue = true;
    requestAnimationFrame(() => {
      this.isDue = false;
      this.paint();
    });
  }

  paint() {
    const pen = this.context;
    const dpr = Math.min(devicePixelRatio || 1, 2);
    const view = this.view();
    if (!view.w || !view.h) return;
    if (this.canvas.width !== Math.round(view.w * dpr) || this.canvas.height !== Math.round(view.h * dpr)) {
      this.canvas.width = Math.round(view.w * dpr);
      this.canvas.height = Math.round(view.h * dpr);
    }
    pen.setTransform(dpr, 0, 0, dpr, 0, 0);
    pen.inks = this.inks;
    pen.clearRect(0, 0, view.w, view.h);
    pen.lineJoin = pen.lineCap = "round";
    this.paintGround(pen, view);
    this.paintPath(pen, view);
    this.paintPoints(pen, view);
    this.paintShapes(pen, view);
    this.paintRobot(pen, view);
  }

  paintGround(pen, { at, scale }) {
    const { panels, rim, base } = this.ground;
    pen.lineWidth = 1;
    pen.strokeStyle = this.inks.seam;
    pen.fillStyle = this.inks.panel;
    for (const [row, col, x, y, hx, hy] of panels) {
      const [left, top] = at(x - hx, y + hy);
      pen.beginPath();
      pen.rect(left, top, 2 * hx * scale, 2 * hy * scale);
      pen.fill();
      pen.stroke();
      if (scale * hx < NUMBER_PX) continue;
      // Between the upper and the middle row of its points.
      pen.fillStyle = this.inks.quiet;
      pen.font = `${Math.min(Math.max(scale * hy * 0.3, 8), 14)}px system-ui`;
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(`${row}-${col}`, left + hx * scale, top + 0.67 * hy * scale);
      pen.textBaseline = "alphabetic";
      pen.fillStyle = this.inks.panel;
    }
    if (rim.length) line(pen, rim.map(([x, y]) => at(x, y)), this.inks.rim, 1.8, true);
    if (base) {
      const [x, y] = at(base[0], base[1]);
      pen.strokeStyle = this.inks.ink;
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.arc(x, y, 6, 0, 7);
      pen.moveTo(x, y);
      pen.lineTo(x + 11 * Math.cos(base[2]), y - 11 * Math.sin(base[2]));
      pen.stroke();
    }
  }

  paintPath(pen, { at }) {
    pen.beginPath();
    let isOn = false;
    for (const [, x, y] of this.path.rows) {
      if (x === null) isOn = false;
      else {
        const [px, py] = at(x, y);
        if (isOn) pen.lineTo(px, py);
        else pen.moveTo(px, py);
        isOn = true;
      }
    }
    pen.strokeStyle = this.inks.estimate;
    pen.lineWidth = 1.4;
    pen.stroke();
  }

  paintPoints(pen, { at, scale }) {
    const r = Math.min(Math.max(scale * 0.02, 2), 7);
    const tolerance = this.ground.arrival_tolerance_mm;
    this.ground.points.forEach(([, x, y], k) => {
      const [px, py] = at(x, y);
      const how = this.states[k] ?? PLANNED;
      pen.beginPath();
      if (how === SKIPPED) {
        pen.strokeStyle = this.inks.warn;
        pen.lineWidth = 2;
        pen.moveTo(px - r, py - r); pen.lineTo(px + r, py + r);
        pen.moveTo(px - r, py + r); pen.lineTo(px + r, py - r);
        pen.stroke();
        return;
      }
      if (how === MEASURED && (this.errors[k] ?? 0) > tolerance) {
        polygon(pen, [[px, py - 1.6 * r], [px + 1.5 * r, py + r], [px - 1.5 * r, py + r]], this.inks.warn);
        return;
      }
      pen.arc(px, py, r, 0, 7);
      if (how === MEASURED) {
        pen.fillStyle = this.inks.good;
        pen.fill();
      } else {
        pen.strokeStyle = how === ARRIVED ? this.inks.note : this.inks.todo;
        pen.lineWidth = how === ARRIVED ? 2.5 : 1.2;
        pen.stroke();
      }
    });
    this.paintNext(pen, at, r);
  }

  // The next point has a ring; a line connects the points after it.
  paintNext(pen, at, r) {
    const next = this.byName?.get(this.mission?.next_point ?? "");
    if (next === undefined || this.mission.state === "done") return;
    const ahead = [next];
    for (let k = next + 1; k < this.ground.points.length && ahead.length < NEXT; k++) if ((this.states[k] ?? PLANNED) === PLANNED) ahead.push(k);
    const places = ahead.map((k) => at(this.ground.points[k][1], this.ground.points[k][2]));
    pen.setLineDash([4, 5]);
    line(pen, this.pose ? [at(this.pose.x_m, this.pose.y_m), ...places] : places, this.inks.note, 1.2, false);
    pen.setLineDash([]);
    pen.strokeStyle = this.inks.note;
    pen.lineWidth = 2.2;
    pen.beginPath();
    pen.arc(...places[0], r + 5, 0, 7);
    pen.stroke();
  }

  paintShapes(pen, { at, scale, w }) {
    for (const shape of this.shapes) {
      const [x, y] = at(shape.x_m, shape.y_m);
      if (shape.outline_m?.length > 1) {
        const places = shape.outline_m.map(([ox, oy]) => at(ox, oy));
        const [first, last] = [shape.outline_m[0], shape.outline_m.at(-1)];
        const isClosed = first[0] === last[0] && first[1] === last[1];
        if (isClosed && FILLED[shape.kind]) polygon(pen, places, this.inks[FILLED[shape.kind]]);
        line(pen, places, shape.kind === "trail" ? this.inks.estimate : this.inks.quiet, 1.5, isClosed);
      }
      if (shape.radius_m) {
        pen.beginPath();
        pen.arc(x, y, shape.radius_m * scale, 0, 7);
        if (FILLED[shape.kind]) {
          pen.fillStyle = this.inks[FILLED[shape.kind]];
          pen.fill();
        }
        pen.strokeStyle = this.inks.quiet;
        pen.lineWidth = 1.2;
        pen.stroke();
      }
      if (shape.covariance_m2) ellipse(pen, x, y, shape.covariance_m2, scale, this.inks.estimate);
      (LOOKS[shape.kind] ?? ((p, px, py) => disc(p, px, py, 4, p.inks.quiet)))(pen, x, y, scale, shape);
      if (shape.heading_rad != null) {
        line(pen, [[x, y], [x + 16 * Math.cos(shape.heading_rad), y - 16 * Math.sin(shape.heading_rad)]], this.inks.ink, 2, false);
      }
      if (shape.label) {
        pen.fillStyle = this.inks.ink;
        pen.font = "12px system-ui";
        const isFar = x > w - 70; // beside the edge it would be cut off
        pen.textAlign = isFar ? "right" : "left";
        pen.fillText(shape.label, isFar ? x - 10 : x + 10, y - 8);
      }
    }
  }

  paintRobot(pen, { at, scale }) {
    if (!this.pose) return;
    const { x_m: x, y_m: y, heading_rad: heading, covariance_m2 } = this.pose;
    const [c, s] = [Math.cos(heading), Math.sin(heading)];
    const sensors = this.ground.edge_sensors_m.map(([sx, sy]) => at(x + c * sx - s * sy, y + s * sx + c * sy));
    const [px, py] = at(x, y);
    pen.globalAlpha = this.isLost ? 0.5 : 1;
    if (sensors.length === 4) {
      const [fl, fr, rl, rr] = sensors;
      pen.globalAlpha *= 0.85;
      polygon(pen, [fl, fr, rr, rl], this.inks.ink);
      pen.globalAlpha = this.isLost ? 0.5 : 1;
      const at2 = (u, v) => at(x + u * c - v * s, y + u * s + v * c);
      const [nose, a, b] = [at2(0.08, 0), at2(-0.05, 0.04), at2(-0.05, -0.04)];
      polygon(pen, [nose, a, b], this.inks.card);
      const r = Math.min(Math.max(scale * 0.014, 1.8), 9);
      sensors.forEach(([sx, sy], k) => {
        if (this.robot?.edges && !this.robot.edges[k]) square(pen, sx, sy, 1.4 * r, this.inks.warn);
        else disc(pen, sx, sy, r, this.robot?.edges ? this.inks.good : this.inks.quiet);
      });
    } else {
      disc(pen, px, py, 6, this.inks.ink);
      line(pen, [[px, py], [px + 16 * c, py - 16 * s]], this.inks.ink, 2, false);
    }
    pen.globalAlpha = 1;
    ellipse(pen, px, py, covariance_m2, this.magnified * scale, this.inks.estimate);
  }
}

function line(pen, places, colour, width, isClosed) {
  pen.beginPath();
  places.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  if (isClosed) pen.closePath();
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
}

function polygon(pen, places, colour) {
  pen.beginPath();
  places.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.closePath();
  pen.fillStyle = colour;
  pen.fill();
}

function cross(pen, x, y, colour) {
  line(pen, [[x - 5, y - 5], [x + 5, y + 5]], colour, 1.5, false);
  line(pen, [[x - 5, y + 5], [x + 5, y - 5]], colour, 1.5, false);
}

function disc(pen, x, y, radius, colour) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 7);
  pen.fillStyle = colour;
  pen.fill();
}

function square(pen, x, y, half, colour) {
  line(pen, [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]], colour, 2, true);
}

// Three sigma.
function ellipse(pen, x, y, [xx, xy, yy], scale, colour) {
  const mean = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
  const major = 3 * Math.sqrt(Math.max(mean + apart, 0)) * scale, minor = 3 * Math.sqrt(Math.max(mean - apart, 0)) * scale;
  if (!(major > 0)) return;
  pen.beginPath();
  pen.ellipse(x, y, Math.max(major, 1), Math.max(minor, 1), -0.5 * Math.atan2(2 * xy, xx - yy), 0, 7);
  pen.strokeStyle = colour;
  pen.lineWidth = 1.5;
  pen.stroke();
}
