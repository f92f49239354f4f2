// Present and past faults of devices, from the robots' fault logs, and their acknowledgement.

import { gateway } from "./gateway.js";
import { $, moment, table, tell } from "./page.js";
import { services } from "./schemas.js";

const COLUMNS = ["Device", "Fault", "Now", "Seen by", "What to do", "Times", "Last"];

export async function lookAtFaults() {
  const logs = services.filter((one) => one.name === "faults" && one.group.endsWith(".faults"));
  const open_only = $("open-faults").checked;
  const lists = await Promise.all(logs.filter((one) => one.allowed).map((one) => faultsOf(one, open_only)));
  const rows = lists.flat().sort((one, other) => other.last_at - one.last_at).map(rowOf);
  const none = open_only ? "Nothing is wrong." : "No fault is known.";
  table($("fault-list"), "Faults, the latest first", COLUMNS, rows, logs.length ? none : "No robot that you may see keeps a log of faults.");
}

async function faultsOf(log, open_only) {
  const may = services.some((one) => one.group === log.group && one.name === "acknowledge" && one.allowed);
  const found = await gateway.call(log.group, "faults", { open_only }, { container: log.container });
  return found.map((one) => ({ ...one, may, log }));
}

function rowOf(one) {
  const see = { label: "I have seen it", act: () => acknowledge(one), name: `I have seen: ${one.text}` };
  const seen = one.acknowledged_by || (one.may ? see : "—");
  return [one.device, said(one), one.open ? "✕ there" : "gone", seen, one.remedy || "—", `${one.count}`, moment(one.last_at)];
}

// The text of the latest occurrence, with its numbers: a kind has none.
function said(one) {
  const begin = `${one.device}: `;
  return one.text.startsWith(begin) ? one.text.slice(begin.length) : one.kind;
}

async function acknowledge(one) {
  try {
    await gateway.call(one.log.group, "acknowledge", { id: one.id }, { container: one.log.container });
    await lookAtFaults();
  } catch (error) {
    tell(`${error.title}: ${error.message}`);
  }
}

$("open-faults").onchange = () => lookAtFaults().catch((error) => tell(error.message));
