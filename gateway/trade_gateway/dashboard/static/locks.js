// Locks: their owners, and how to request, break and release them.

import { gateway } from "./gateway.js";
import { $, button, clock, make, show, write } from "./page.js";

let locks = [];

export const lockOn = (resources) => locks.find((one) => one.resources.some((name) => resources.includes(name)));

export const lockedIn = (container) => locks.filter((one) => one.container === container).length;

export async function lookForLocks() {
  locks = await gateway.get("/locks");
  const mine = new Map([...gateway.locks].map(([lock, resources]) => [[...resources].sort().join(), lock]));
  const nameOf = (one) => mine.get([...one.resources].sort().join());
  const key = JSON.stringify([locks, [...gateway.locks.keys()]]);
  show($("lock-list"), key, () => (locks.length ? locks.map((one) => lockCard(one, nameOf(one))) : [make("li", { class: "note" }, "Nothing is locked.")]));
}

function lockCard(one, mine) {
  const asked = { resources: one.resources };
  const said = make("p", { role: "status" });
  const attempt = async (path, reason, done) => {
    try {
      await gateway.post(path, { ...asked, reason });
      write(said, done);
    } catch (error) {
      write(said, `✕ ${error.title}: ${error.message}`);
    }
  };
  const reason = make("input", { autocomplete: "off", maxlength: 200, required: true });
  const breaking = make("form", { class: "line", hidden: true }, make("label", {}, "Reason ", reason), make("button", { type: "submit", class: "stop" }, "Break it: what moves under it stops"));
  breaking.onsubmit = (event) => {
    event.preventDefault();
    attempt("/locks/break", reason.value, "Broken.");
  };
  const begin = button("Break …", () => {
    breaking.hidden = !breaking.hidden;
    if (!breaking.hidden) reason.focus();
  });
  const hands = mine
    ? [button("Give it back", () => gateway.unlock(mine).catch((error) => write(said, error.message)))]
    : [button("Ask for it", () => attempt("/locks/request", "asked from the dashboard", "Its owner was asked.")), begin];
  const lines = [
    ["Owner", mine ? `${one.owner} (this page)` : one.owner],
    ["Purpose", one.purpose || "—"],
    ["Since", clock(one.since)],
    ["Waiting", one.waiting.join(", ") || "—"],
  ];
  const figures = make("dl", { class: "figures" }, ...lines.map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text))));
  return make("li", { class: "card" }, make("h3", {}, one.resources.join(", ")), figures, make("div", { class: "line" }, ...hands), breaking, said);
}

$("lock-form").onsubmit = async (event) => {
  event.preventDefault();
  write($("lock-problem"), "");
  try {
    await gateway.lock($("lock-group").value, $("lock-purpose").value, 2);
  } catch (error) {
    write($("lock-problem"), `✕ ${error.title}: ${error.message}`);
  }
};
