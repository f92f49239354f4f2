// The system: containers, notifications and hooks.

import { door } from "./door.js";
import { $, measure, table } from "./page.js";

export async function lookAtContainers() {
  const [there, loads] = await Promise.all([door.get("/containers"), door.get("/loads")]);
  const busy = new Map(loads.map((one) => [one.container, one]));
  const rows = there.sort((one, other) => one.name.localeCompare(other.name)).map((one) => {
    const load = busy.get(one.name);
    const memory = load?.memory_bytes;
    return [
      one.name, one.identity, one.host, measure(load?.cpu_percent, 0, "%"), measure(load?.host_cpu_percent, 0, "%"),
      memory ? `${(memory / 1e6).toFixed(0)} MB` : "—", measure(load?.calls_per_s, 1, "/s"), measure(load?.in_flight, 0, ""),
    ];
  });
  table($("container-list"), "Containers, over the last second", ["Container", "Identity", "Host", "CPU", "Host’s CPU", "Memory", "Calls", "Running"], rows, "No container is there.");
}

export async function lookAtWatchers() {
  if (!door.me.reads) {
    table($("watcher-list"), "", [], [], "They are for who may read the system (group trade).");
    return;
  }
  const [standing, hooks] = await Promise.all([door.get("/notifications"), door.get("/hooks")]);
  const rows = [
    ...standing.map((one) => [one.occasion, one.call, one.condition || "—", one.owner, `${one.fired}`, `${one.failures}`, one.last_error || one.state]),
    ...hooks.map((one) => [`${one.side} ${one.target}`, one.call, "—", one.owner, `${one.fired}`, `${one.failures}`, one.last_error || (one.suspended ? "suspended" : "attached")]),
  ];
  table($("watcher-list"), "Notifications and hooks", ["Occasion", "Call", "Condition", "Owner", "Fired", "Failed", "State"], rows, "No notification and no hook stands.");
}
