// The dashboard: a client of the HTTP API like any other. It connects, polls, disconnects and reconnects.

import { readCalls, showCalls } from "./calls.js";
import { lookAtContainers } from "./containers.js";
import { STATE_HZ } from "./devices.js";
import { gateway } from "./gateway.js";
import { lookForEstops } from "./estop.js";
import { lookAtFaults } from "./faults.js";
import { lookForLocks } from "./locks.js";
import { readLog } from "./log.js";
import { $, sleep, tell, write } from "./page.js";
import { forget, lookAround, paintAll } from "./robots.js";
import { lookAtAudit, lookAtNotifications, lookAtPolicy, lookAtSight } from "./system.js";

const ASK_AGAIN_MS = 1000;
const LONGEST_PAUSE_MS = 4000;

/** Poll while connected and visible. A robot without an answer is gone. */
async function keepAsking(look, every_ms) {
  for (;;) {
    if (gateway.connected && document.visibilityState === "visible") {
      try {
        await look();
      } catch (error) {
        if (error.name === "TimeoutError" || error.name === "TypeError") gateway.drop();
        else tell(`${error.title ?? error.name}: ${error.message}`);
      }
    }
    await sleep(every_ms);
  }
}

let changed = 0;

function lookIn(pause_ms) {
  clearTimeout(changed);
  changed = setTimeout(look, pause_ms);
}

function onChange() {
  lookIn(300);
}

/** Until it succeeds, the controls of an earlier connection stay disabled. */
function look() {
  lookAround().catch((error) => {
    tell(error.message);
    if (gateway.connected) lookIn(ASK_AGAIN_MS);
  });
}

function showConnection(connected) {
  write($("link"), connected ? "● Connected" : "✕ Not connected: what you see is old. Trying again …");
  write($("who"), gateway.me ? `as ${gateway.me.identity}` : "");
  document.body.classList.toggle("offline", !connected);
  $("leave").hidden = !gateway.token;
}

/** Wait for a token. */
async function signIn(error) {
  [$("inside").hidden, $("login").hidden] = [true, false];
  write($("link"), "Not signed in");
  write($("who"), "");
  document.body.classList.remove("offline");
  document.body.classList.add("outside");
  write($("login-problem"), gateway.token ? error.message : "");
  $("token").focus();
  await new Promise((done) => {
    $("login-form").onsubmit = (event) => {
      event.preventDefault();
      gateway.token = $("token").value.trim();
      $("token").value = "";
      done();
    };
  });
  sessionStorage.setItem("token", gateway.token);
  document.body.classList.remove("outside");
}

$("leave").onclick = () => {
  sessionStorage.removeItem("token");
  location.reload();
};

async function main() {
  let pause_ms = 250;
  for (;;) {
    try {
      gateway.me = await gateway.get("/me");
      const { closed } = await gateway.open();
      [$("inside").hidden, $("login").hidden] = [false, true];
      showConnection(true);
      pause_ms = 250;
      forget();
      gateway.begin({ do: "watch" }, onChange).ended.catch(() => {});
      if (gateway.me.reads) {
        readLog();
        readCalls();
      } else write($("log-problem"), "This needs the right to read the system (group trade).");
      look();
      await closed;
    } catch (error) {
      if (error.status === 401 || error.status === 403) {
        gateway.me = null;
        await signIn(error);
        continue;
      }
    }
    if (gateway.me) showConnection(false);
    await sleep(pause_ms);
    pause_ms = Math.min(pause_ms * 2, LONGEST_PAUSE_MS);
  }
}

setInterval(paintAll, 1000 / STATE_HZ);
keepAsking(lookForEstops, ASK_AGAIN_MS);
keepAsking(lookAtSight, 2 * ASK_AGAIN_MS);
keepAsking(lookForLocks, ASK_AGAIN_MS);
keepAsking(lookAtContainers, 4 * ASK_AGAIN_MS);
keepAsking(lookAtNotifications, 3 * ASK_AGAIN_MS);
keepAsking(lookAtFaults, 2 * ASK_AGAIN_MS);
keepAsking(showCalls, ASK_AGAIN_MS);
keepAsking(lookAtPolicy, 5 * ASK_AGAIN_MS);
keepAsking(lookAtAudit, 5 * ASK_AGAIN_MS);
main();
