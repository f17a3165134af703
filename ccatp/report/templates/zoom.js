// Figures zoom: buttons, or Ctrl and the wheel; dragging moves them. Without this script, and on paper, they are whole.
"use strict";

const MOST = 40;

for (const svg of document.querySelectorAll("figure svg")) {
  const { x, y, width, height } = svg.viewBox.baseVal;
  const view = { x, y, width, height };
  const axes = JSON.parse(svg.dataset.axes || "[]");
  const readout = document.createElement("output");

  // The view has the proportions of the figure, so that the page does not move.
  const show = () => {
    view.x = Math.min(Math.max(view.x, x), x + width - view.width);
    view.y = Math.min(Math.max(view.y, y), y + height - view.height);
    svg.setAttribute("viewBox", [view.x, view.y, view.width, view.height].join(" "));
    svg.classList.toggle("zoomed", view.width < width);
  };
  const place = (event) => {
    const box = svg.getBoundingClientRect();
    return [
      view.x + ((event.clientX - box.left) / box.width) * view.width,
      view.y + ((event.clientY - box.top) / box.height) * view.height,
    ];
  };
  const zoom = (factor, [atX, atY] = [view.x + view.width / 2, view.y + view.height / 2]) => {
    const share = Math.min(Math.max(view.width / width / factor, 1 / MOST), 1);
    const scale = (share * width) / view.width;
    view.x = atX - (atX - view.x) * scale;
    view.y = atY - (atY - view.y) * scale;
    view.width = share * width;
    view.height = share * height;
    show();
  };
  const reset = () => zoom(1 / MOST);

  // Each of the axes: its label, its ends in the figure and their values, and whether it is logarithmic.
  const read = (at) => {
    const shares = axes.map(({ ends }, k) => (at[k] - ends[0]) / (ends[1] - ends[0]));
    const words = axes.map(({ label, values: [low, high], log }, k) => {
      const value = log ? low * (high / low) ** shares[k] : low + shares[k] * (high - low);
      return label && `${label}: ${value.toPrecision(4)}`;
    });
    readout.value = shares.every((share) => share >= 0 && share <= 1) ? words.filter(Boolean).join("; ") : "";
  };

  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    const step = Math.min(Math.max(event.deltaY * (event.deltaMode ? 16 : 1), -50), 50);
    zoom(Math.exp(-step / 100), place(event));
  }, { passive: false });
  svg.addEventListener("dblclick", (event) => zoom(2, place(event)));
  svg.addEventListener("pointerdown", (event) => {
    if (event.button || view.width >= width) return;
    event.preventDefault();
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (svg.hasPointerCapture(event.pointerId)) {
      const box = svg.getBoundingClientRect();
      view.x -= (event.movementX / box.width) * view.width;
      view.y -= (event.movementY / box.height) * view.height;
      show();
    }
    read(place(event));
  });
  window.addEventListener("beforeprint", reset);

  const bar = document.createElement("div");
  bar.className = "zoom";
  bar.append(readout);
  const buttons = [["+", "zoom in", () => zoom(2)], ["\u2212", "zoom out", () => zoom(0.5)], ["\u21ba", "show all", reset]];
  for (const [text, what, act] of buttons) {
    const button = document.createElement("button");
    button.textContent = text;
    button.title = `${what} (Ctrl and the wheel zoom, dragging moves)`;
    button.addEventListener("click", act);
    bar.append(button);
  }
  svg.before(bar);
}
