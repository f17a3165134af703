// Terms of the page that need a sentence: shown on hover, and on a tap or a click.
const TERMS = {
  nis: "NIS, normalized innovation squared: how far a measurement is from what the filter expected, in its own standard deviations squared, per degree of freedom. 1 on average if the filter is consistent.",
  innovation: "By how much a fix of the laser moved the estimated position.",
  dop: "DOP, dilution of precision: standard deviation of the position divided by that of a measured length. It depends only on the places of collimators and reflector; lower is better.",
  residual: "What the measured lengths leave over when the position fits them best, root mean square.",
  permit: "The danger loop permits each direction of motion for every frame. The robot turns its wheels only with a fresh permit and a fresh drive.",
  "permit-age": "Time since the robot received the permit that is in force. An old one has no effect any more.",
  "drive-age": "Time since the robot received the set points of its wheels that are in force. Old ones have no effect any more.",
  "sensors-age": "Time since the main loop received the newest frame of the robot.",
  grip: "Thrust of the fans at full duty, divided by the least thrust that holds the robot everywhere on the mirror, with the friction that turns show.",
  sigma: "Three standard deviations of the estimated position, in its worst direction.",
};
const NAMES = { "laser DOP": "dop", "laser residual": "residual", "sensors, age": "sensors-age", "permit, age": "permit-age", "drive, age": "drive-age", grip: "grip" };

// The term that explains the value of this name, or nothing.
export const termOf = (name) => NAMES[name];

export function explain(root, popover) {
  const of = (event) => event.target.closest?.("[data-term]");
  root.addEventListener("mouseover", (event) => {
    const node = of(event);
    if (node) node.title = TERMS[node.dataset.term];
  });
  root.addEventListener("click", (event) => {
    const node = of(event);
    if (!node) return;
    popover.textContent = TERMS[node.dataset.term];
    popover.togglePopover(true);
  });
}
