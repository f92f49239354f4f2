// The section System: the graph and the table of containers, and what an administrator can change of one.

import { confirmed, said } from "./confirm.js";
import { LONG_MS, gateway } from "./gateway.js";
import { drawGraph, linkedWith, linksOf } from "./graph.js";
import { lockedIn } from "./locks.js";
import { $, button, make, measure, show, table, write } from "./page.js";
import { services } from "./schemas.js";

const COLUMNS = ["Container", "Details", "Host", "Identity", "Groups", "Linked with", "CPU", "Host’s CPU", "Memory", "Calls", "Running"];
let [states, chosen] = [[], ""];

export async function lookAtContainers() {
  states = await gateway.get("/system", LONG_MS);
  paint();
  const busy = new Map((await gateway.get("/loads")).map((one) => [one.container, one]));
  const { pairs } = linksOf(states);
  const rows = states.map((one) => {
    const load = busy.get(one.name);
    const memory = load?.memory_bytes;
    return [
      one.name, { label: "Show", act: () => choose(one.name, true), name: `Show container ${one.name}` }, one.host || one.state, one.identity || "—", inShort(one.groups), linkedWith(one.name, pairs).join(", ") || "—",
      measure(load?.cpu_percent, 0, "%"), measure(load?.host_cpu_percent, 0, "%"), memory ? `${(memory / 1e6).toFixed(0)} MB` : "—",
      measure(load?.calls_per_s, 1, "/s"), measure(load?.in_flight, 0, ""),
    ];
  });
  table($("container-list"), "Containers, over the last second", COLUMNS, rows, "There is no container.");
}

function choose(name, focus = false) {
  if (name !== chosen) confirmed($("container-confirm"));
  chosen = name;
  paint();
  if (focus) $("container-card").focus();
}

function paint() {
  const groups = [...new Set(states.flatMap((one) => one.groups))].sort();
  show($("graph-group"), JSON.stringify(groups), () => {
    const was = $("graph-group").value;
    return ["", ...groups].map((name) => make("option", { value: name, selected: name === was }, name || "none"));
  });
  drawGraph($("graph"), states, chosen, $("graph-group").value, choose);
  const one = states.find((each) => each.name === chosen);
  $("container-card").hidden = !one;
  if (one) showCard(one);
}

/** The groups; of many, only how many there are of each first word. */
function inShort(groups) {
  if (groups.length <= 4) return listed(groups);
  const counts = new Map();
  for (const word of groups.map((name) => name.split(".")[0])) counts.set(word, (counts.get(word) ?? 0) + 1);
  return [...counts].map(([word, count]) => (count === 1 ? word : `${word} (${count} groups)`)).join(", ");
}

const known = (value) => (value === null ? "not known here" : value ? "on" : "off");
const listed = (names) => names.join(", ") || "—";

function showCard(one) {
  const { pairs } = linksOf(states);
  const lines = [
    ["Host", one.host || "no process"],
    ["Identity", one.identity || "—"],
    ["Services", `${one.services}, of which ${one.actuating} can move something`],
    ["Linked with", listed(linkedWith(one.name, pairs))],
    ["Discovery", known(one.discovery)],
    ["Broadcast", known(one.broadcast)],
    ["Supervised by", one.supervised_by ? `${one.supervised_by}: ${one.state}, restarted ${one.restarts} times${one.why ? `, ${one.why}` : ""}` : "no gateway"],
    ["Supervises", listed(one.supervises)],
    ["Groups", listed(one.groups)],
  ];
  write($("container-name"), `Container ${one.name}`);
  show($("container-facts"), JSON.stringify(lines), () => lines.map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text))));
  const rights = rightsOf(one);
  write($("container-rights"), rights);
  show($("container-actions"), JSON.stringify([one, rights, states.map((each) => each.name)]), () => actionsOf(one));
}

const covers = (over, group) => over.includes("*") || over.some((name) => group === name || group.startsWith(`${name}.`));
const movable = (one) => one.groups.filter((group) => covers(gateway.me.over, group));

function rightsOf(one) {
  if (gateway.me.administers) return "";
  const moving = movable(one).length ? " You may move providers." : " Nor may you administer a group here, so you cannot move a provider.";
  return `You may not change this container: that needs the right to administer the system (group trade), which ${gateway.me.identity} does not have.${moving}`;
}

function actionsOf(one) {
  const may = gateway.me.administers;
  const at = `/containers/${encodeURIComponent(one.name)}`;
  const offer = (label, allowed, ask) => button(`${label} …`, () => ask(), { disabled: !allowed, "aria-describedby": "container-rights" });
  const ask = (title, text, path, fields, bodyOf) => confirmed($("container-confirm"), { title, text, fields, act: (given) => change(path, bodyOf(given)) });
  const restart = () => ask(`${one.host ? "Restart" : "Start"} ${one.name}`, textOf(one, true), `${at}/restart`, [], () => ({ reason: "from the dashboard" }));
  const end = () => ask(`End ${one.name}`, textOf(one, false), `${at}/end`, [], () => ({ reason: "from the dashboard" }));
  const move = () => {
    const fields = [["group", "Provider of group", movable(one)], ["to", "To container", others(one)]];
    const count = (group) => services.filter((each) => each.container === one.name && each.group === group).length;
    const text = ({ group, to }) => `Moves the provider of ${group} (${plural(count(group), "service")}) with its state from ${one.name} to ${to}. No device moves. Callers are refused meanwhile, and it stays if it is locked or moves.`;
    ask("Move a provider", text, "/migrate", fields, (given) => ({ ...given, container: one.name }));
  };
  const create = () => {
    const fields = [["class_path", "Class (module:Class)"], ["group", "Group"]];
    const text = ({ class_path, group }) => `Creates ${class_path || "an object"} in ${one.name} and offers it${group ? ` in group ${group}` : ""}. The container must allow the class. Nothing ends.`;
    ask("Create a provider", text, "/instantiate", fields, ({ class_path, group }) => ({ container: one.name, class_path, groups: group ? [group] : [] }));
  };
  const there = Boolean(one.identity);
  return [
    offer(one.host ? "Restart" : "Start", may && Boolean(one.supervised_by), restart),
    offer("End", may && Boolean(one.host) && !one.own, end),
    ...["discovery", "broadcast"].flatMap((what) => switches(one, what).map((on) => offer(`Turn ${what} ${on ? "on" : "off"}`, may && there, () => ask(`Turn ${what} ${on ? "on" : "off"} in ${one.name}`, SWITCHED[`${what} ${on}`](one.name), `${at}/${what}`, [], () => ({ on }))))),
    offer("Move a provider", there && movable(one).length > 0 && others(one).length > 0, move),
    offer("Create a provider", may && there, create),
  ];
}

const switches = (one, what) => (one[what] === null ? [true, false] : [!one[what]]);
const others = (one) => states.filter((each) => each.identity && each.name !== one.name).map((each) => each.name);
const plural = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;

const SWITCHED = {
  "discovery true": (name) => `${name} links to every container of this system that broadcasts, where it listens: on its host, or on its networks. Nothing ends and nothing moves.`,
  "discovery false": (name) => `${name} no longer searches for containers. Its links stay; nothing ends and nothing moves.`,
  "broadcast true": (name) => `${name} answers containers of this system that search. Nothing ends and nothing moves.`,
  "broadcast false": (name) => `${name} no longer answers containers that search. Its links stay; nothing ends and nothing moves.`,
};

/** What restarting or ending a container does, and to what. */
function textOf(one, again) {
  const locked = lockedIn(one.name);
  if (!one.host) return `${one.supervised_by} starts ${one.name}, with the state that it saved. Nothing moves.`;
  const ends = [`Ends ${plural(one.services, "service")} of ${one.name}${one.host ? ` on ${one.host}` : ""}.`];
  ends.push(one.actuating ? `${one.actuating} of them can move something: what moves there stops.` : "Nothing moves.");
  if (locked) ends.push(`${plural(locked, "lock")} there ${locked === 1 ? "is" : "are"} lost.`);
  if (one.supervises.length) ends.push(`It supervises ${one.supervises.join(", ")}, which end too.`);
  if (again) ends.push(`${one.supervised_by} starts it again, with the state that it saved.`);
  else ends.push(one.supervised_by ? `${one.supervised_by} starts it again only on request.` : "No gateway starts it again.");
  return ends.join(" ");
}

async function change(path, body) {
  const { text } = await gateway.post(path, body);
  lookAtContainers().catch((error) => said($("container-confirm"), error.message));
  return text;
}

$("graph-group").onchange = paint;
addEventListener("resize", () => states.length && paint());
