// The log of all processes.

import { gateway } from "./gateway.js";
import { $, clock, make, write } from "./page.js";

const MOST_LINES = 300;

let log = null;

export function readLog() {
  if (log) gateway.cancel(log.id);
  $("log-lines").replaceChildren();
  write($("log-problem"), "");
  const reading = gateway.begin({ do: "logs", level: Number($("level").value) }, ({ line }) => {
    if (reading !== log) return;
    const [kind, name] = line.level >= 40 ? ["bad", "error"] : line.level >= 30 ? ["warn", "warning"] : ["", line.level >= 20 ? "info" : "debug"];
    $("log-lines").prepend(make("li", { class: kind }, make("time", {}, clock(line.at)), ` ${name} ${line.container}: ${line.text}`));
    while ($("log-lines").childElementCount > MOST_LINES) $("log-lines").lastChild.remove();
  });
  log = reading;
  reading.ended.catch((error) => reading === log && gateway.connected && write($("log-problem"), `${error.title}: ${error.message}`));
}

$("level").onchange = readLog;
