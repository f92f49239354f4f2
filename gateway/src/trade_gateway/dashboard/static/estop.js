// The e-stop: always there, and Esc presses it.

import { door } from "./door.js";
import { releaseAll } from "./jog.js";
import { $, button, clock, make, show, tell } from "./page.js";

let open_estops = [];
let said_of_estop = ""; // what came of the last press here

async function pressEstop() {
  releaseAll();
  said_of_estop = "Stopping everything …";
  showEstops();
  try {
    said_of_estop = reportOf(await door.estop("dashboard"));
  } catch (error) {
    said_of_estop = `✕ THE E-STOP WAS NOT CONFIRMED: ${error.message} Use the hardware’s own.`;
  }
  showEstops();
  await lookForEstops().catch(() => {}); // what came of it stays
}

function reportOf(told) {
  const failed = Object.entries(told.failed).map(([who, why]) => `${who}: ${why}`);
  return [
    `Confirmed by ${told.confirmed.join(", ") || "nobody"}.`,
    told.missing.length ? `✕ NOT CONFIRMED by ${told.missing.join(", ")}.` : "",
    failed.length ? `✕ Failed: ${failed.join("; ")}.` : "",
  ].filter(Boolean).join(" ");
}

export async function lookForEstops() {
  open_estops = await door.get("/estops");
  showEstops();
}

function showEstops() {
  const open = open_estops;
  show($("stopped"), JSON.stringify([open, said_of_estop, door.me?.administers]), () => [
    open.length ? make("strong", {}, "E-STOP: nothing moves until it is cleared.") : "",
    ...open.map((one) => make("p", {}, `${clock(one.at)} ${one.by}: ${one.reason}`)),
    said_of_estop ? make("p", {}, said_of_estop) : "",
    open.length && door.me?.administers ? button("Clear the e-stop", () => clearEstop(open)) : "",
    open.length && !door.me?.administers ? make("p", {}, "Who administers the system may clear it.") : "",
    !open.length && said_of_estop ? button("Understood", forgetEstop) : "",
  ].filter(Boolean));
}

function forgetEstop() {
  said_of_estop = "";
  showEstops();
}

async function clearEstop(open) {
  try {
    const told = await door.post("/estop/clear", { ids: open.map((one) => one.id) });
    said_of_estop = "";
    tell(told.complete ? "The e-stop is cleared. Nothing moves by itself, and what it stopped not before it is let." : `Not cleared by ${told.missing.join(", ")}.`);
  } catch (error) {
    tell(`${error.title}: ${error.message}`);
  }
  await lookForEstops().catch(() => {}); // it is looked for again anyway
}

$("estop").onclick = pressEstop;
addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || event.repeat || event.isComposing || !door.me) return;
  event.preventDefault();
  pressEstop();
}, true);
