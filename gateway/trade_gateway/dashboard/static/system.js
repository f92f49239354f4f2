// The system: notifications and hooks, rules and policy, the audit record.

import { confirmed } from "./confirm.js";
import { showEditors } from "./editor.js";
import { LONG_MS, gateway } from "./gateway.js";
import { $, make, moment, show, table, write } from "./page.js";
import { services } from "./schemas.js";

const ADMINISTERS = "Ending them needs the right to administer the system (group trade).";
const VERBS = ["call", "read", "register", "lock", "instrument", "administer"];

/** Endpoints that the HTTP gateway does not reach: robots behind them are not on this page, and receive no e-stop. */
export async function lookAtSight() {
  const { others, apart } = await gateway.get("/sight", LONG_MS);
  const said = Object.entries(apart).map(([where, why]) => `✕ The HTTP gateway reaches no container at ${where} (its TRADE_CONNECT): ${why}`);
  if (!others.length) said.push("✕ The HTTP gateway finds no other container in its system: no robot receives an e-stop from here.");
  else if (said.length) said.push("The robots there are not on this page, and receive no e-stop from here.");
  show($("apart"), JSON.stringify(said), () => said.map((one) => make("p", {}, one)));
}

export async function lookAtNotifications() {
  if (!gateway.me.reads) {
    table($("notification-list"), "", [], [], "This needs the right to read the system (group trade).");
    return;
  }
  write($("notification-rights"), gateway.me.administers ? "" : ADMINISTERS);
  const [standing, hooks] = await Promise.all([gateway.get("/notifications"), gateway.get("/hooks")]);
  const end = (label, title, text, path) => ({
    label,
    name: title,
    why: gateway.me.administers ? "" : ADMINISTERS,
    act: () => confirmed($("notification-confirm"), { title, text, act: async () => (await gateway.request("DELETE", path, undefined, LONG_MS)).text }),
  });
  const cancel = (one) => end("Cancel …", `Cancel notification ${one.id}`, `Ends the notification “${one.occasion}” of ${one.owner} in ${one.container}: it no longer calls ${one.call}. A call that it has begun continues; nothing else ends and nothing moves.`, `/notifications/${encodeURIComponent(one.id)}`);
  const detach = (one) => end("Detach …", `Detach hook ${one.id}`, `Ends the hook of ${one.owner} ${one.side} ${one.target}, in all containers: ${one.call} is no longer called. The services stay; nothing moves.`, `/hooks/${encodeURIComponent(one.id)}`);
  const rows = [
    ...standing.map((one) => [one.occasion, cancel(one), one.call, one.condition || "—", one.owner, one.container, `${one.fired}`, `${one.failures}`, one.last_error || one.state]),
    ...hooks.map((one) => [`${one.side} ${one.target}`, detach(one), one.call, "—", one.owner, one.container, `${one.fired}`, `${one.failures}`, [one.suspended ? "suspended" : "", one.last_error].filter(Boolean).join(": ") || "attached"]),
  ];
  table($("notification-list"), "Notifications and hooks", ["Occasion", "End it", "Call", "Condition", "Owner", "Container", "Fired", "Failed", "State"], rows, "There are no notifications and no hooks.");
}

export async function lookAtPolicy() {
  await lookAtRules();
  if (!gateway.me.reads) {
    table($("policy-list"), "", [], [], "This needs the right to read the system (group trade).");
    return;
  }
  const [{ governed, identities, revoked }, files] = await Promise.all([gateway.get("/policy"), gateway.get("/rules")]);
  showEditors(governed, files.map((one) => one.container));
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
