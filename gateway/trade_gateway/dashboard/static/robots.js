// The robots: their devices, by group.

import { Chain, chainsOf } from "./chain.js";
import { Arm, Gripper, Joint } from "./devices.js";
import { gateway } from "./gateway.js";
import { releaseAll } from "./jog.js";
import { $, make, show, write } from "./page.js";
import { lookForServices, operationOf, resolve, services } from "./schemas.js";
import { showServices } from "./services.js";

const devices = new Map(); // by group
let chains = [];
let shape = "";

export function paintAll() {
  for (const device of devices.values()) device.paint();
  for (const chain of chains) chain.paint();
  showFaults([...devices.values()].filter((one) => one.state?.fault || one.problem));
}

function showFaults(bad) {
  const unheard = [...devices.values()].filter((one) => !one.state).length;
  const key = JSON.stringify([devices.size, unheard, bad.map((one) => one.group)]);
  $("ailing").className = bad.length ? "problem" : "note";
  show($("ailing"), key, () => {
    if (!devices.size) return [];
    if (!bad.length && unheard) return [`… ${unheard} of ${devices.size} have not been heard yet.`];
    if (!bad.length) return ["✓ Nothing reports a fault."];
    const links = bad.map((one) => make("a", { href: `#at-${one.group}` }, one.name));
    return [`✕ ${bad.length} of ${devices.size} have a fault or are silent: `, ...links.flatMap((link, place) => (place ? [", ", link] : [link]))];
  });
}

function kindOf(state) {
  const answer = operationOf(state)?.responses["200"].content["application/json"].schema.properties.result;
  const fields = resolve(answer)?.properties ?? {};
  if ("position_rad" in fields) return Joint;
  if ("width_m" in fields) return Gripper;
  return "positions_rad" in fields ? Arm : null;
}

let looking = Promise.resolve();

/** Refresh the list of robots, one refresh at a time. */
export function lookAround() {
  looking = looking.catch(() => {}).then(lookOnce);
  return looking;
}

async function lookOnce() {
  await lookForServices();
  showServices();
  const groups = new Map();
  for (const one of services) {
    if (!groups.has(one.group)) groups.set(one.group, new Map());
    groups.get(one.group).set(one.name, one);
  }
  $("groups").replaceChildren(...[...groups.keys()].sort().map((group) => make("option", { value: group })));
  const now = JSON.stringify(services.map((one) => [one.container, one.group, one.name, one.allowed]).sort());
  if (now === shape) return;
  shape = now;
  await arrange(groups);
}

async function arrange(groups) {
  releaseAll();
  for (const device of devices.values()) device.leave();
  devices.clear();
  const members = new Map();
  for (const [group, inside] of groups) {
    const kind = inside.has("state") ? kindOf(inside.get("state")) : null;
    if (kind) devices.set(group, new kind(group, inside));
    else if (inside.has("joints")) members.set(group, await gateway.call(group, "joints").catch(() => []));
  }
  const robots = new Map();
  for (const group of devices.keys()) {
    const name = group.split(".")[0];
    robots.set(name, [...(robots.get(name) ?? []), group]);
  }
  chains = [];
  const shown = [...robots].sort().map(([name, inside]) => robotCard(name, inside, members));
  $("robot-list").replaceChildren(...(shown.length ? shown : [make("p", { class: "note" }, "There is no robot, or none that you may see.")]));
  followAll([...devices.values()]);
}

/** In turn: a client may have 16 operations at once. */
async function followAll(all) {
  for (const device of all) await device.follow();
}

function robotCard(name, groups, members) {
  const left = new Set(groups);
  const parts = [];
  for (const [group, joints] of [...members].sort()) {
    const inside = joints.filter((joint) => left.delete(joint)).map((joint) => devices.get(joint));
    if (inside.length) parts.push(part(group, inside, chainsOf(inside)));
  }
  for (const group of [...left].sort()) {
    const device = devices.get(group);
    parts.push(part(group, [device], device instanceof Arm ? [[device]] : []));
  }
  return make("article", { class: "robot", "aria-label": `Robot ${name}` }, make("h3", {}, name), ...parts);
}

function part(group, inside, sketched) {
  const made = sketched.map((joints) => new Chain(group, joints));
  chains.push(...made);
  for (const joints of sketched) joints.forEach((joint, place) => joints.length > 1 && write(joint.number, `${place + 1}`));
  const title = make("h4", { class: "group" }, group.split(".").slice(1).join(".") || group);
  const sketches = made.length ? make("div", { class: "sketches" }, ...made.map((chain) => chain.svg)) : null;
  const alone = inside.length === 1 && inside[0].group === group;
  return make("section", { class: "part" }, alone ? null : title, sketches, make("ul", { class: "devices" }, ...inside.map((one) => one.element)));
}

/** Refresh everything after a new connection. Until then, of what is shown only stops can be used. */
export function forget() {
  shape = "";
  for (const device of devices.values()) device.outdated = true;
}

$("speed").oninput = () => {
  write($("speed-value"), `${$("speed").value} %`);
  for (const device of devices.values()) device.write_speed();
};
