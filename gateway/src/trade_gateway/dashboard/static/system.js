// The system: containers, notifications and hooks, rules and policy, the audit record.

import { LONG_MS, gateway } from "./gateway.js";
import { $, make, measure, moment, show, table } from "./page.js";
import { services } from "./schemas.js";

const VERBS = ["call", "read", "register", "lock", "instrument", "administer"];

/** Endpoints that the HTTP gateway does not reach: robots behind them are not on this page, and receive no e-stop. */
export async function lookAtSight() {
  const { others, apart } = await gateway.get("/sight", LONG_MS);
  const said = Object.entries(apart).map(([where, why]) => `✕ The HTTP gateway reaches no container at ${where} (its TRADE_CONNECT): ${why}`);
  if (!others.length) said.push("✕ The HTTP gateway finds no other container in its system: no robot receives an e-stop from here.");
  else if (said.length) said.push("The robots there are not on this page, and receive no e-stop from here.");
  show($("apart"), JSON.stringify(said), () => said.map((one) => make("p", {}, one)));
}

export async function lookAtContainers() {
  const [there, loads] = await Promise.all([gateway.get("/containers"), gateway.get("/loads")]);
  const busy = new Map(loads.map((one) => [one.container, one]));
  const rows = there.sort((one, other) => one.name.localeCompare(other.name)).map((one) => {
    const load = busy.get(one.name);
    const memory = load?.memory_bytes;
    return [
      one.name, one.identity, one.host, measure(load?.cpu_percent, 0, "%"), measure(load?.host_cpu_percent, 0, "%"),
      memory ? `${(memory / 1e6).toFixed(0)} MB` : "—", measure(load?.calls_per_s, 1, "/s"), measure(load?.in_flight, 0, ""),
    ];
  });
  table($("container-list"), "Containers, over the last second", ["Container", "Identity", "Host", "CPU", "Host’s CPU", "Memory", "Calls", "Running"], rows, "There is no container.");
}

export async function lookAtNotifications() {
  if (!gateway.me.reads) {
    table($("notification-list"), "", [], [], "This needs the right to read the system (group trade).");
    return;
  }
  const [standing, hooks] = await Promise.all([gateway.get("/notifications"), gateway.get("/hooks")]);
  const rows = [
    ...standing.map((one) => [one.occasion, one.call, one.condition || "—", one.owner, `${one.fired}`, `${one.failures}`, one.last_error || one.state]),
    ...hooks.map((one) => [`${one.side} ${one.target}`, one.call, "—", one.owner, `${one.fired}`, `${one.failures}`, one.last_error || (one.suspended ? "suspended" : "attached")]),
  ];
  table($("notification-list"), "Notifications and hooks", ["Occasion", "Call", "Condition", "Owner", "Fired", "Failed", "State"], rows, "There are no notifications and no hooks.");
}

export async function lookAtPolicy() {
  await lookAtRules();
  if (!gateway.me.reads) {
    table($("policy-list"), "", [], [], "This needs the right to read the system (group trade).");
    return;
  }
  const { governed, identities, revoked } = await gateway.get("/policy");
  const rows = [
    ...identities.map((one) => [one.name, one.roles.join(", ") || "—", ...VERBS.map((verb) => one.rights[verb].join(", ") || "—")]),
    ...revoked.map((name) => [name, "revoked", ...VERBS.map(() => "—")]),
  ];
  const none = governed ? "The policy names no identity." : "There is no policy: every client may do everything.";
  table($("policy-list"), "Who may do what in which groups", ["Identity", "Roles", ...VERBS], rows, none);
}

async function lookAtRules() {
  const engines = services.filter((one) => one.name === "rules" && one.group === "rules" && one.allowed);
  const found = await Promise.all(engines.map((one) => gateway.call("rules", "rules", {}, { container: one.container })));
  const rows = found.flat().map((one) => [one.name, one.occasion, one.condition || "—", one.container, `${one.fired}`, `${one.failed}`, one.why || one.last_error || one.state]);
  table($("rule-list"), "Rules by which the system configures itself", ["Rule", "Occasion", "Condition", "Runs in", "Fired", "Failed", "State"], rows, "There are no rules.");
}

export async function lookAtAudit() {
  const columns = ["At", "Kind", "Who", "What", "About", "In", "Outcome"];
  let [rows, none] = [[], "This needs the right to administer the system."];
  if (gateway.me.administers) {
    try {
      const found = await gateway.get("/audit");
      rows = found.map((one) => [moment(one.at), one.kind, one.who || "—", one.what, one.about || "—", one.container, one.why || one.outcome]);
      none = "Nothing is on record.";
    } catch (error) {
      if (error.status !== 404) throw error;
      none = error.message;
    }
  }
  table($("audit-list"), "The newest rows of this host", columns, rows, none);
}
