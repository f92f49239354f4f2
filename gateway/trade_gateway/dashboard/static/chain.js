// A robot's joints as chains.

import { draw } from "./page.js";

/** Links of equal length, each turned by its joint's angle from the one before: a sketch, not to scale. */
export class Chain {
  #box = null;

  constructor(name, parts) {
    this.parts = parts;
    this.line = draw("polyline", { class: "links" });
    this.base = draw("path", { class: "base", d: "M-.55 .12H.55M-.4 .12l-.16 .26M-.1 .12l-.16 .26M.2 .12l-.16 .26M.5 .12l-.16 .26" });
    this.svg = draw("svg", { class: "chain", role: "img" }, this.base, this.line);
    this.svg.setAttribute("aria-label", `Sketch of ${name}: ${parts.map((one) => one.name).join(", ")}; the angles are in the list`);
    this.dots = [];
  }

  paint() {
    const angles = this.parts.flatMap((part) => part.angles);
    if (!angles.length) return;
    const points = [[0, 0]];
    let heading = -Math.PI / 2;
    for (const angle of angles) {
      heading -= angle; // positive turns against the clock
      const [x, y] = points.at(-1);
      points.push([x + Math.cos(heading), y + Math.sin(heading)]);
    }
    while (this.dots.length < angles.length) {
      const text = draw("text", { dy: ".14" }, `${this.dots.length + 1}`);
      const dot = draw("g", {}, draw("circle", { r: 0.26 }), text);
      this.dots.push(dot);
      this.svg.append(dot);
    }
    this.line.setAttribute("points", points.map((point) => point.map((value) => value.toFixed(3)).join(",")).join(" "));
    this.dots.forEach((dot, place) => {
      dot.setAttribute("transform", `translate(${points[place][0].toFixed(3)} ${points[place][1].toFixed(3)})`);
      const part = this.parts.length === 1 ? this.parts[0] : this.parts[place];
      dot.setAttribute("class", part.state?.fault ? "bad" : part.state?.moving ? "moving" : "");
    });
    this.#fit(points);
  }

  /** The frame grows with what it has to show, and does not jump. */
  #fit(points) {
    const was = this.#box ?? [-0.9, -0.9, 0.9, 0.6];
    const [xs, ys] = [points.map((point) => point[0]), points.map((point) => point[1])];
    const box = [
      Math.min(was[0], ...xs.map((x) => x - 0.5)),
      Math.min(was[1], ...ys.map((y) => y - 0.5)),
      Math.max(was[2], ...xs.map((x) => x + 0.5)),
      Math.max(was[3], ...ys.map((y) => y + 0.5)),
    ];
    if (this.#box && box.every((side, place) => side === this.#box[place])) return;
    this.#box = box;
    this.svg.setAttribute("viewBox", `${box[0]} ${box[1]} ${box[2] - box[0]} ${box[3] - box[1]}`);
  }
}

/** A group such as two legs is several chains: a new one begins where a joint's last name comes again. */
export function chainsOf(joints) {
  const chains = [];
  for (const joint of joints) {
    const last = joint.name.split(".").at(-1);
    if (!chains.length || chains.at(-1).some((one) => one.name.split(".").at(-1) === last)) chains.push([]);
    chains.at(-1).push(joint);
  }
  return chains;
}
