// Calls of the whole system as they end, while its containers trace them.

import { gateway } from "./gateway.js";
import { $, clock, table, tell, write } from "./page.js";

const MOST_CALLS = 100;
const COLUMNS = ["Ended", "Service", "In", "For", "Took", "Outcome"];
const ended = new Map(); // by call; its callee's record has more data than its caller's

let reading = null;

/** Read recorded calls; an ended connection delivers none. */
export function readCalls() {
  if (reading) gateway.cancel(reading.id);
  ended.clear();
  const here = gateway.begin({ do: "calls", reads: $("call-reads").checked }, ({ call }) => {
    if (here === reading && !(call.side === "asked" && ended.has(call.id))) {
      ended.delete(call.id);
      ended.set(call.id, call);
    }
    if (ended.size > MOST_CALLS) ended.delete(ended.keys().next().value);
  });
  reading = here;
  here.ended.catch((error) => here === reading && gateway.connected && write($("call-problem"), `${error.title}: ${error.message}`));
}

export function showCalls() {
  for (const button of [$("trace-calls"), $("stop-tracing")]) button.disabled = !(gateway.me?.instruments && gateway.connected);
  if (!gateway.me?.reads) {
    table($("call-list"), "", [], [], "This needs the right to read the system (group trade).");
    return;
  }
  const wanted = $("call-search").value.toLowerCase();
  const rows = [...ended.values()].reverse().map(rowOf).filter((row) => row.join(" ").toLowerCase().includes(wanted));
  table($("call-list"), "The latest calls", COLUMNS, rows, ended.size ? "None of them is like that." : "No call has been traced yet.");
}

function rowOf(call) {
  const client = call.session.split("/")[3]; // of an HTTP gateway: the client behind it
  const who = client ? `${call.caller} for ${client.slice(0, client.lastIndexOf("."))}` : call.caller;
  return [clock(call.began + call.took_s), call.service, call.container, who, `${(call.took_s * 1000).toFixed(1)} ms`, call.outcome];
}

async function trace(on) {
  try {
    const { containers } = await gateway.post("/tracing", { on });
    tell(`${on ? "Calls are traced" : "Calls are no longer traced"} in ${containers.join(", ") || "no container"}.`);
  } catch (error) {
    tell(`${error.title}: ${error.message}`);
  }
}

$("trace-calls").onclick = () => trace(true);
$("stop-tracing").onclick = () => trace(false);
$("call-reads").onchange = readCalls;
$("call-search").oninput = showCalls;
