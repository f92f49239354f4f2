// The containers of the system by host, and the links between them. The table below the graph says the same.

import { draw, make, show } from "./page.js";

const [LINE, LEFT, GAP, HEAD] = [18, 12, 10, 30];

/** Pairs of linked containers. Where no container reports its links: those that this HTTP gateway has found. */
export function linksOf(states) {
  const known = states.filter((one) => one.links);
  const pairs = known.flatMap((one) => one.links.map((to) => [one.name, to].sort()));
  const own = states.find((one) => one.own)?.name;
  const found = own ? states.filter((one) => one.identity && !one.own).map((one) => [own, one.name].sort()) : [];
  const all = new Map((known.length ? pairs : found).map((pair) => [pair.join("\n"), pair]));
  return { pairs: [...all.values()], reported: known.length > 0 };
}

export const linkedWith = (name, pairs) => pairs.filter((pair) => pair.includes(name)).map(([one, other]) => (one === name ? other : one)).sort();

const offers = (one, group) => one.groups.some((name) => name === group || name.startsWith(`${group}.`));

/** Draw the graph: containers below each other, by host; links are arcs beside them. `choose` gets a container's name. */
export function drawGraph(element, states, chosen, group, choose) {
  const width = Math.max(280, Math.min(element.clientWidth, 760));
  const { pairs, reported } = linksOf(states);
  show(element, JSON.stringify([width, chosen, group, states, pairs]), () => {
    const focused = document.activeElement?.dataset?.container;
    const inside = Math.min(430, width * 0.66);
    const [nodes, hosts, height] = placed(states, inside, chosen, group);
    const arcs = pairs.filter((pair) => pair.every((name) => nodes.has(name))).map((pair) => arc(pair, nodes, inside, width, chosen, reported));
    const svg = draw("svg", { class: "graph", width, height, viewBox: `0 0 ${width} ${height}`, role: "group" }, ...hosts, ...arcs);
    svg.setAttribute("aria-label", "Containers by host, and their links. The table below says the same.");
    for (const [name, node] of nodes) {
      node.element.setAttribute("aria-label", `${name}: linked with ${linkedWith(name, pairs).join(", ") || "no container"}`);
      node.element.onclick = () => choose(name);
      node.element.onkeydown = (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        choose(name);
      };
      svg.append(node.element);
    }
    if (focused) requestAnimationFrame(() => nodes.get(focused)?.element.focus());
    const said = reported ? "Lines are links that containers report." : "Dashed: containers that this HTTP gateway has found. They do not report their links to you.";
    return [svg, make("p", { class: "note" }, said)];
  });
}

/** The boxes: containers by name, with the middle of each; the hosts; and the height of it all. */
function placed(states, inside, chosen, group) {
  const [nodes, hosts, by_host] = [new Map(), [], new Map()];
  for (const one of states) by_host.set(one.host, [...(by_host.get(one.host) ?? []), one]);
  let y = 1;
  for (const [host, there] of [...by_host].sort(([one], [other]) => (one === "") - (other === "") || one.localeCompare(other))) {
    const top = y;
    y += HEAD;
    for (const one of there) {
      const lines = linesOf(one, inside);
      const high = LINE * (lines.length + 1) + 10;
      const box = draw("rect", { x: LEFT, y, width: inside - 2 * LEFT, height: high, rx: 8 });
      const texts = [draw("text", { class: "name", x: LEFT + 10, y: y + 20 }, cut(one.own ? `${one.name} (this page)` : one.name, inside - 44, 9.4))];
      lines.forEach((line, place) => texts.push(draw("text", { x: LEFT + 10, y: y + 20 + LINE * (place + 1) }, line)));
      const kind = ["container", one.host ? "" : "gone", group && offers(one, group) ? "marked" : ""].filter(Boolean).join(" ");
      const element = draw("g", { class: kind, role: "button", tabindex: 0, "aria-pressed": one.name === chosen, "data-container": one.name }, box, ...texts);
      nodes.set(one.name, { element, middle: y + high / 2 });
      y += high + GAP;
    }
    const box = draw("rect", { class: "host", x: 1, y: top, width: inside - 2, height: y - top, rx: 12 });
    hosts.push(box, draw("text", { class: "host-name", x: LEFT, y: top + 20 }, cut(host ? `Host ${host}` : "Without a process", inside - 24, 8)));
    y += GAP;
  }
  return [nodes, hosts, y];
}

function linesOf(one, inside) {
  const about = one.identity ? `${one.services} service${one.services === 1 ? "" : "s"}` : `${one.state}${one.why ? `: ${one.why}` : ""}`;
  const groups = one.groups.length ? [one.groups.join(", ")] : [];
  return [about, ...groups].map((line) => cut(line, inside - 44, 7.2));
}

const cut = (text, width, each) => (text.length * each <= width ? text : `${text.slice(0, Math.max(1, Math.floor(width / each) - 1))}…`);

function arc(pair, nodes, inside, width, chosen, reported) {
  const [from, to] = pair.map((name) => nodes.get(name).middle).sort((one, other) => one - other);
  const x = inside - LEFT;
  const out = x + Math.min(width - x - 6, 26 + (to - from) * 0.45);
  const shape = `M${x} ${from}C${out} ${from} ${out} ${to} ${x} ${to}`;
  const kind = ["link", reported ? "" : "found", pair.includes(chosen) ? "chosen" : ""].filter(Boolean).join(" ");
  return draw("path", { class: kind, d: shape });
}
