// The e-stop: always visible, and Esc presses it. It reports only what robots have confirmed.
// In a text field, Esc leaves the field first, unless a call of this page that may move something is under way.

import { gateway } from "./gateway.js";
import { releaseAll } from "./jog.js";
import { $, button, clock, make, show, tell } from "./page.js";

const FIELD = "textarea, select, [contenteditable], input:not([type=range], [type=checkbox], [type=radio], [type=button], [type=submit])";
const CUT = "use the switch that cuts the power.";

let open_estops = [];
let pressed = null; // result of the last press here: the id that all have confirmed, or the problem; and the rest

async function pressEstop() {
  releaseAll();
  say({ wrong: "Stopping everything … NO ROBOT HAS CONFIRMED IT YET." });
  try {
    say(outcomeOf(await gateway.estop("dashboard")));
  } catch (error) {
    say({ wrong: `✕ NO ROBOT CONFIRMED: ${CUT}`, rest: error.message });
  }
  await lookForEstops().catch(() => {}); // the result stays
}

function say(outcome) {
  pressed = outcome;
  showEstops();
}

function outcomeOf(report) {
  const failed = Object.entries(report.failed).map(([who, why]) => `${who}: ${why}`);
  const apart = Object.entries(report.apart).map(([where, why]) => `${where}: ${why}`);
  const wrong = [
    report.confirmed.length ? "" : "NO ROBOT CONFIRMED",
    report.missing.length ? `NOT CONFIRMED by ${report.missing.join(", ")}` : "",
    failed.length ? `FAILED at ${failed.join("; ")}` : "",
    apart.length ? `NO CONTAINER REACHED at ${apart.join("; ")}` : "",
  ].filter(Boolean).join("; ");
  const rest = report.confirmed.length ? `Confirmed by ${report.confirmed.join(", ")}.` : "";
  return wrong || !report.complete ? { wrong: `✕ ${wrong || "NOT CONFIRMED BY ALL"}: ${CUT}`, rest } : { id: report.id, rest };
}

export async function lookForEstops() {
  open_estops = await gateway.get("/estops");
  showEstops();
}

/** Only the page that pressed it knows its confirmations. */
function headline() {
  if (pressed?.wrong) return pressed.wrong;
  if (open_estops.some((one) => one.id === pressed?.id)) return "E-STOP: nothing moves until it is cleared.";
  return open_estops.length ? "E-STOP: robots that have received it do not move until it is cleared. This page does not know whether all of them have received it." : "";
}

function showEstops() {
  const open = open_estops;
  show($("stopped"), JSON.stringify([open, pressed, gateway.me?.administers]), () => [
    headline() ? make("strong", {}, headline()) : "",
    pressed?.rest ? make("p", {}, pressed.rest) : "",
    ...open.map((one) => make("p", {}, `${clock(one.at)} ${one.by}${one.told_by ? ` (reported by ${one.told_by})` : ""}: ${one.reason}`)),
    open.length && gateway.me?.administers ? button("Clear the e-stop", () => clearEstop(open)) : "",
    open.length && !gateway.me?.administers ? make("p", {}, "Clearing it needs the right to administer the system.") : "",
    !open.length && pressed ? button("Understood", () => say(null)) : "",
  ].filter(Boolean));
}

async function clearEstop(open) {
  try {
    const report = await gateway.post("/estop/clear", { ids: open.map((one) => one.id) });
    pressed = null;
    tell(report.complete ? "The e-stop is cleared. Nothing moves by itself; what it stopped must be resumed first." : `Not cleared by ${report.missing.join(", ") || "any visible container"}.`);
  } catch (error) {
    tell(`${error.title}: ${error.message}`);
  }
  await lookForEstops().catch(() => {}); // the next poll looks again anyway
}

function leftField(target) {
  const field = gateway.acting ? null : target.closest?.(FIELD);
  field?.blur();
  return Boolean(field);
}

$("estop").onclick = pressEstop;
addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || event.repeat || event.isComposing || !gateway.me) return;
  event.preventDefault();
  if (leftField(event.target)) tell("You have left the field. Press Esc again for the e-stop.");
  else pressEstop();
}, true);
