// The dashboard: a client of the door like any other. All that it knows of the other side is in docs/http.md.

const JOG_EVERY_MS = 80;
const JOG_VALID_S = 0.2; // so long a set-point holds: whatever happens to this page, motion ends then
const STATE_HZ = 5;
const STALE_MS = 1500;
const ASK_AGAIN_MS = 1000;
const ESTOP_WITHIN_MS = 1000;
const SILENT_MS = 3000; // a door that answers nothing for so long is as good as gone
const LONGEST_PAUSE_MS = 4000;
const TOLD_FOR_MS = 10000;
const MOST_LINES = 300;

const $ = (id) => document.getElementById(id);
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

// --- elements: text is only ever set as text

/** An element; strings and numbers are attributes, anything else a property. */
function make(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (typeof value === "string" || typeof value === "number") made.setAttribute(name, value);
    else if (value !== undefined) made[name] = value;
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

function draw(tag, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const button = (text, onclick, properties = {}) => make("button", { type: "button", onclick, ...properties }, text);

/** Set a text if it is another one: what has not changed is not read out again. */
function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Show children if they are others, told by a key. */
function show(element, key, children) {
  if (element.dataset.shown === key) return;
  element.dataset.shown = key;
  element.replaceChildren(...children());
}

const fixed = (value, digits) => (value >= 0 ? "+" : "−") + Math.abs(value).toFixed(digits);
const degrees = (rad) => `${fixed((rad * 180) / Math.PI, 1)}°`;
const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString();

let told_for = 0;

/** Say something in passing. */
function tell(text) {
  write($("told"), text);
  clearTimeout(told_for);
  told_for = setTimeout(() => write($("told"), ""), TOLD_FOR_MS);
}

// --- the door

/** What the door or the system would not do, with the problem as it was told. */
class Refused extends Error {
  constructor(problem) {
    super(problem.detail || problem.title);
    this.title = problem.title;
    this.status = problem.status;
    this.data = problem.data;
  }
}

const lost = () => new Refused({ title: "NotConnected", status: 0, detail: "There is no connection to the door." });

class Door {
  token = sessionStorage.getItem("token") || "";
  locks = new Map(); // those of this page: name -> resources
  #socket = null;
  #under_way = new Map();
  #number = 0;

  get connected() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  async request(method, path, body) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
    if (body) headers["Content-Type"] = "application/json";
    const options = { method, headers, body: body && JSON.stringify(body), cache: "no-store" };
    const answer = await fetch(path, { ...options, signal: AbortSignal.timeout(method === "GET" ? SILENT_MS : 15000) });
    const told = await answer.json();
    if (!answer.ok) throw new Refused(told);
    return told;
  }

  get(path) {
    return this.request("GET", path);
  }

  post(path, body) {
    return this.request("POST", path, body);
  }

  /** Connect; resolves once connected, with a promise of the end. */
  open() {
    const place = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`;
    const socket = new WebSocket(place, this.token ? ["trade.v1", `bearer.${this.token}`] : ["trade.v1"]);
    this.#socket = socket;
    return new Promise((resolve, reject) => {
      const closed = new Promise((ended) => {
        socket.onclose = () => {
          reject(lost());
          this.#forget();
          ended();
        };
      });
      socket.onopen = () => resolve({ closed });
      socket.onmessage = (event) => this.#hear(JSON.parse(event.data));
    });
  }

  drop() {
    this.#socket?.close();
    this.#forget();
  }

  #forget() {
    this.#socket = null;
    this.locks.clear();
    releaseAll();
    for (const { reject } of this.#under_way.values()) reject(lost());
    this.#under_way.clear();
  }

  #hear(told) {
    if (told.event === "lock_lost") {
      this.locks.delete(told.lock);
      releaseAll();
      tell(`A lock was lost: ${told.problem.detail}`);
      return;
    }
    const waiting = this.#under_way.get(told.id);
    if (!waiting) return;
    if (!("result" in told) && !("problem" in told)) {
      waiting.heard(told);
      return;
    }
    this.#under_way.delete(told.id);
    if ("problem" in told) waiting.reject(new Refused(told.problem));
    else waiting.resolve(told.result);
  }

  /** Begin something; `heard` gets what is said on the way, `ended` is how it ends. */
  begin(message, heard = () => {}) {
    const id = ++this.#number;
    const ended = new Promise((resolve, reject) => {
      if (!this.connected) {
        reject(lost());
        return;
      }
      this.#under_way.set(id, { resolve, reject, heard });
      this.#socket.send(JSON.stringify({ ...message, id }));
    });
    return { id, ended };
  }

  ask(message) {
    return this.begin(message).ended;
  }

  call(group, name, args = {}, options = {}) {
    return this.ask({ do: "call", group, name, args, ...options });
  }

  cancel(which) {
    if (this.connected) this.ask({ do: "cancel", which }).catch(() => {});
  }

  async lock(group, purpose, wait_s) {
    const taken = await this.ask({ do: "lock", group, purpose, wait_s });
    this.locks.set(taken.lock, taken.resources);
    return taken.lock;
  }

  async unlock(lock) {
    this.locks.delete(lock);
    await this.ask({ do: "unlock", lock });
  }

  has_locked(resources) {
    const mine = new Set([...this.locks.values()].flat());
    return resources.length > 0 && resources.every((one) => mine.has(one));
  }

  /** Stop everything: over the socket, and if that says nothing in time, over a request of its own. */
  async estop(reason) {
    const stopped = this.connected ? this.ask({ do: "estop", reason }).catch(() => null) : null;
    return (await Promise.race([stopped, sleep(stopped ? ESTOP_WITHIN_MS : 0)])) ?? this.post("/estop", { reason });
  }
}

const door = new Door();
let me = null;

// --- hold to move

const held = new Set();

function releaseAll() {
  for (const jog of [...held]) jog.release();
}

/** One direction of one joint. It moves while it is held and this page is visible, by set-points that end by themselves. */
class Jog {
  #moving = false;
  #stopped = Promise.resolve();

  constructor(joint, sign) {
    this.joint = joint;
    this.sign = sign;
    const way = sign < 0 ? "negative" : "positive";
    const label = `Hold to turn ${joint.name} in the ${way} direction`;
    const parts = [make("span", { "aria-hidden": "true" }, sign < 0 ? "◀ −" : "+ ▶"), make("small")];
    this.button = make("button", { type: "button", class: "hold", "aria-label": label, "aria-pressed": "false" }, ...parts);
    this.button.onpointerdown = (event) => {
      if (event.button !== 0) return;
      this.button.setPointerCapture(event.pointerId);
      this.press();
    };
    for (const end of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) {
      this.button.addEventListener(end, () => this.release());
    }
    this.button.oncontextmenu = (event) => event.preventDefault(); // of a long press
    this.button.onkeydown = (event) => {
      if (event.key !== " " && event.key !== "Enter") return;
      event.preventDefault();
      if (!event.repeat) this.press();
    };
    this.button.onkeyup = (event) => {
      if (event.key === " " || event.key === "Enter") this.release();
    };
    this.button.onclick = (event) => {
      if (event.detail === 0 && !this.pressed) this.joint.say("Hold Space or Enter to move.");
    };
  }

  get pressed() {
    return held.has(this);
  }

  get speed_rad_s() {
    return (this.joint.limits.max_speed_rad_s * Number($("speed").value)) / 100;
  }

  press() {
    if (this.pressed || this.button.disabled || document.visibilityState !== "visible" || !door.connected) return;
    held.add(this);
    this.button.setAttribute("aria-pressed", "true");
    this.joint.say("");
    this.joint.busy = this.joint.busy.then(() => this.#run());
  }

  release() {
    if (!held.delete(this)) return;
    this.button.setAttribute("aria-pressed", "false");
    if (this.#moving) this.#stopped = this.joint.stop();
  }

  async #run() {
    if (!this.pressed) return;
    const { group, resources } = this.joint;
    let lock = "";
    try {
      if (!door.has_locked(resources)) lock = await door.lock(group, "jog by hand", 0.5);
      while (this.pressed) {
        this.#moving = true;
        const next = sleep(JOG_EVERY_MS);
        const args = { velocity_rad_s: this.sign * this.speed_rad_s, valid_s: JOG_VALID_S };
        await door.call(group, "set_velocity", args, { deadline_s: 1 }); // one at a time: none piles up on a slow link
        await next;
      }
    } catch (error) {
      if (this.pressed) this.joint.refused(error);
    } finally {
      this.release();
      this.#moving = false;
      await this.#stopped;
      if (lock && door.connected) await door.unlock(lock).catch((error) => this.joint.refused(error));
    }
  }
}

addEventListener("blur", releaseAll);
addEventListener("pagehide", releaseAll);
document.addEventListener("visibilitychange", releaseAll);
$("speed").oninput = () => {
  write($("speed-value"), `${$("speed").value} %`);
  for (const device of devices.values()) device.write_speed?.();
};

// --- devices

const devices = new Map(); // by group

/** What the services of a group are of, and what was last measured of it. */
class Device {
  state = null;
  limits = null;
  problem = "";
  busy = Promise.resolve();
  #heard_at = 0;
  #stream = 0;

  constructor(group, services) {
    this.group = group;
    this.services = services;
    this.name = group.split(".").slice(1).join(".") || group;
    this.resources = [...new Set([...services.values()].flatMap((one) => one.resources))];
    this.element = this.build();
  }

  get stale() {
    return performance.now() - this.#heard_at > STALE_MS;
  }

  may(name) {
    return this.services.get(name)?.allowed ?? false;
  }

  /** Follow its state until it is no device of this page any more; resolves once something was heard. */
  follow() {
    return new Promise((first) => this.#follow(first));
  }

  async #follow(first) {
    while (devices.get(this.group) === this && door.connected) {
      try {
        if (this.services.has("limits")) this.limits ??= await door.call(this.group, "limits");
        this.write_speed?.();
        const stream = { do: "stream", group: this.group, name: "state", hz: STATE_HZ };
        const { id, ended } = door.begin(stream, (told) => {
          this.#heard(told);
          first();
        });
        this.#stream = id;
        await ended;
      } catch (error) {
        this.problem = error.message;
        first();
      }
      await sleep(ASK_AGAIN_MS);
    }
    first();
  }

  #heard(told) {
    this.problem = told.failed ? told.failed.detail : "";
    if (!told.sample) return;
    this.state = told.sample.value;
    this.#heard_at = performance.now();
  }

  leave() {
    door.cancel(this.#stream);
    this.element.remove();
  }

  async stop() {
    try {
      await door.call(this.group, "stop", {}, { deadline_s: 5 });
    } catch (error) {
      if (error.title !== "Cancelled") this.refused(error);
    }
  }

  say(text) {
    write(this.message, text);
    this.resume.hidden = true;
  }

  refused(error) {
    this.say(`${error.title}: ${error.message}`);
    this.resume.hidden = error.title !== "Stopped";
  }

  /** Under a lock, as that is for whoever has it, or administers the joint. */
  async let_move_again() {
    let lock = "";
    try {
      if (!door.has_locked(this.resources)) lock = await door.lock(this.group, "let it move again", 0.5);
      await door.ask({ do: "resume", group: this.group });
      this.say("It may move again.");
    } catch (error) {
      this.refused(error);
    }
    if (lock && door.connected) await door.unlock(lock).catch((error) => this.refused(error));
  }

  build() {
    this.message = make("p", { class: "problem", role: "status" });
    this.resume = button("Let it move again", () => this.let_move_again(), { hidden: true });
    this.badges = make("p", { class: "badges" });
    this.locked = make("span", { class: "locked" });
    this.trouble = make("p", { class: "problem" });
    this.figures = make("dl", { class: "figures" });
    this.stopping = button("Stop", () => this.stop(), { class: "stop", "aria-label": `Stop ${this.name}` });
    this.hands = make("div", { class: "hands" }, this.stopping);
    this.number = make("span", { class: "number" });
    const title = make("h4", {}, this.number, this.name);
    const notes = make("div", { class: "notes", tabindex: 0, "aria-label": `Notes on ${this.name}`, role: "group" }, this.trouble, this.message, this.resume);
    const owner = make("p", { class: "owner" }, "Locked by ", this.locked);
    const parts = [title, this.badges, this.picture(), this.figures, owner, this.hands, notes];
    return make("li", { class: "device", id: `at-${this.group}` }, ...parts);
  }

  picture() {
    return null;
  }

  paint() {
    const { state } = this;
    const silent = this.problem || (state ? this.stale && "not heard of lately" : "no data yet");
    const wrong = [silent, state?.fault && `fault: ${state.fault}`].filter(Boolean).join("; ");
    write(this.trouble, wrong && `✕ ${wrong}`);
    const words = state ? this.words(state) : [];
    show(this.badges, JSON.stringify(words), () => words.map((text) => make("span", { class: "badge" }, text)));
    const lock = lockOn(this.resources);
    write(this.locked, lock ? `${lock.owner}, ${lock.purpose}` : "nobody");
    this.element.classList.toggle("stale", !state || this.stale || !door.connected);
    if (!state) return;
    const figures = this.measured(state);
    if (this.figures.childElementCount !== figures.length) {
      this.figures.replaceChildren(...figures.map(([name]) => make("div", {}, make("dt", {}, name), make("dd"))));
    }
    figures.forEach(([, text], place) => write(this.figures.children[place].lastChild, text));
  }

  words(state) {
    return [state.moving ? "▶ moving" : "■ at rest"];
  }

  measured() {
    return [];
  }
}

class Joint extends Device {
  picture() {
    this.mark = draw("rect", { class: "mark", y: 0, width: 2.4, height: 10, rx: 1.2 });
    this.zero = draw("rect", { class: "zero", y: 2, width: 0.6, height: 6 });
    const track = draw("rect", { class: "track", y: 3, width: 100, height: 4, rx: 2 });
    this.bar = draw("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", role: "meter" }, track, this.zero, this.mark);
    this.bar.setAttribute("aria-label", `Position of ${this.name}`);
    [this.least, this.most] = [make("span"), make("span")];
    this.jogs = this.services.has("set_velocity") ? [new Jog(this, -1), new Jog(this, 1)] : [];
    this.hands.prepend(...this.jogs.map((jog) => jog.button));
    return make("div", { class: "range" }, this.least, this.bar, this.most);
  }

  write_speed() {
    if (this.limits) for (const jog of this.jogs) write(jog.button.lastChild, `${jog.speed_rad_s.toFixed(3)} rad/s`);
  }

  words(state) {
    const closed = this.jogs.length && !this.may("set_velocity") ? ["⊘ look only"] : [];
    return [...super.words(state), state.enabled ? "● torque on" : "○ torque off", ...closed];
  }

  measured(state) {
    const found = [
      ["Position", `${fixed(state.position_rad, 3)} rad (${degrees(state.position_rad)})`],
      ["Velocity", `${fixed(state.velocity_rad_s, 3)} rad/s`],
      ["Load", `${Math.round(state.load * 100)} %`],
    ];
    if (state.temperature_c !== null) found.push(["Temperature", `${state.temperature_c.toFixed(0)} °C`]);
    if (state.voltage_v !== null) found.push(["Supply", `${state.voltage_v.toFixed(1)} V`]);
    return found;
  }

  paint() {
    super.paint();
    const { state, limits } = this;
    const allowed = this.may("set_velocity");
    for (const jog of this.jogs) jog.button.disabled = !(allowed && limits && door.connected);
    this.stopping.disabled = !door.connected;
    if (!state || !limits) return;
    const at = (rad) => (100 * (rad - limits.min_rad)) / (limits.max_rad - limits.min_rad);
    this.mark.setAttribute("x", Math.min(Math.max(at(state.position_rad), 0), 100) - 1.2);
    this.zero.setAttribute("x", at(0) - 0.3);
    write(this.least, fixed(limits.min_rad, 2));
    write(this.most, `${fixed(limits.max_rad, 2)} rad`);
    this.bar.setAttribute("aria-valuemin", limits.min_rad);
    this.bar.setAttribute("aria-valuemax", limits.max_rad);
    this.bar.setAttribute("aria-valuenow", state.position_rad.toFixed(3));
    this.bar.setAttribute("aria-valuetext", `${state.position_rad.toFixed(3)} rad`);
  }

  get angles() {
    return [this.state?.position_rad ?? 0];
  }
}

class Gripper extends Device {
  picture() {
    this.fingers = [draw("rect", { y: 6, width: 5, height: 22, rx: 2 }), draw("rect", { y: 6, width: 5, height: 22, rx: 2 })];
    const palm = draw("rect", { x: 12, y: 26, width: 76, height: 8, rx: 3 });
    return draw("svg", { class: "gripper", viewBox: "0 0 100 36", "aria-hidden": "true" }, palm, ...this.fingers);
  }

  words(state) {
    const words = [...super.words(state), state.activated ? "● activated" : "○ not activated"];
    return state.holding ? [...words, "● holds something"] : words;
  }

  measured(state) {
    return [
      ["Width", `${(state.width_m * 1000).toFixed(1)} mm`],
      ["Force", `${state.force_n.toFixed(0)} N`],
      ["Current", `${state.current_a.toFixed(2)} A`],
    ];
  }

  paint() {
    super.paint();
    if (!this.state || !this.limits) return;
    const half = 32 * (this.state.width_m / this.limits.max_width_m);
    this.fingers[0].setAttribute("x", 45 - half);
    this.fingers[1].setAttribute("x", 50 + half);
  }
}

class Arm extends Device {
  words(state) {
    return [...super.words(state), state.enabled ? "● brakes released" : "○ brakes on", `safety: ${state.safety}`];
  }

  measured(state) {
    const [x, y, z] = state.pose;
    const angles = state.positions_rad.map((rad, place) => [`Joint ${place + 1}`, `${fixed(rad, 3)} rad (${degrees(rad)})`]);
    return [...angles, ["Tool", `x ${fixed(x, 3)}, y ${fixed(y, 3)}, z ${fixed(z, 3)} m`]];
  }

  get angles() {
    return this.state?.positions_rad ?? [];
  }
}

// --- a robot's joints as chains

/** Links of equal length, each turned by its joint's angle from the one before: a sketch, not to scale. */
class Chain {
  #box = null;

  constructor(name, parts) {
    this.parts = parts;
    this.line = draw("polyline", { class: "links" });
    this.base = draw("path", { class: "base", d: "M-.55 .12H.55M-.4 .12l-.16 .26M-.1 .12l-.16 .26M.2 .12l-.16 .26M.5 .12l-.16 .26" });
    this.svg = draw("svg", { class: "chain", role: "img" }, this.base, this.line);
    this.svg.setAttribute("aria-label", `Sketch of ${name}: ${parts.map((one) => one.name).join(", ")}; the angles are in the list`);
    this.dots = [];
  }

  paint() {
    const angles = this.parts.flatMap((part) => part.angles);
    if (!angles.length) return;
    const points = [[0, 0]];
    let heading = -Math.PI / 2;
    for (const angle of angles) {
      heading -= angle; // positive turns against the clock
      const [x, y] = points.at(-1);
      points.push([x + Math.cos(heading), y + Math.sin(heading)]);
    }
    while (this.dots.length < angles.length) {
      const text = draw("text", { dy: ".14" }, `${this.dots.length + 1}`);
      const dot = draw("g", {}, draw("circle", { r: 0.26 }), text);
      this.dots.push(dot);
      this.svg.append(dot);
    }
    this.line.setAttribute("points", points.map((point) => point.map((value) => value.toFixed(3)).join(",")).join(" "));
    this.dots.forEach((dot, place) => {
      dot.setAttribute("transform", `translate(${points[place][0].toFixed(3)} ${points[place][1].toFixed(3)})`);
      const part = this.parts.length === 1 ? this.parts[0] : this.parts[place];
      dot.setAttribute("class", part.state?.fault ? "bad" : part.state?.moving ? "moving" : "");
    });
    this.#fit(points);
  }

  /** The frame grows with what it has to show, and does not jump. */
  #fit(points) {
    const was = this.#box ?? [-0.9, -0.9, 0.9, 0.6];
    const [xs, ys] = [points.map((point) => point[0]), points.map((point) => point[1])];
    const box = [
      Math.min(was[0], ...xs.map((x) => x - 0.5)),
      Math.min(was[1], ...ys.map((y) => y - 0.5)),
      Math.max(was[2], ...xs.map((x) => x + 0.5)),
      Math.max(was[3], ...ys.map((y) => y + 0.5)),
    ];
    if (this.#box && box.every((side, place) => side === this.#box[place])) return;
    this.#box = box;
    this.svg.setAttribute("viewBox", `${box[0]} ${box[1]} ${box[2] - box[0]} ${box[3] - box[1]}`);
  }
}

/** A group such as two legs is several chains: a new one begins where a joint's last name comes again. */
function chainsOf(joints) {
  const chains = [];
  for (const joint of joints) {
    const last = joint.name.split(".").at(-1);
    if (!chains.length || chains.at(-1).some((one) => one.name.split(".").at(-1) === last)) chains.push([]);
    chains.at(-1).push(joint);
  }
  return chains;
}

let chains = [];

function paintAll() {
  for (const device of devices.values()) device.paint();
  for (const chain of chains) chain.paint();
  showFaults([...devices.values()].filter((one) => one.state?.fault || one.problem));
}

function showFaults(bad) {
  const key = JSON.stringify([devices.size, bad.map((one) => one.group)]);
  $("faults").className = bad.length ? "problem" : "note";
  show($("faults"), key, () => {
    if (!devices.size) return [];
    if (!bad.length) return ["✓ Nothing reports a fault."];
    const links = bad.map((one) => make("a", { href: `#at-${one.group}` }, one.name));
    return [`✕ ${bad.length} of ${devices.size} have a fault or are silent: `, ...links.flatMap((link, place) => (place ? [", ", link] : [link]))];
  });
}

// --- which robots there are

let services = [];
let described = { paths: {}, components: { schemas: {} } };
let shape = "";

function resolve(schema) {
  const name = schema?.$ref?.split("/").at(-1);
  return name ? resolve(described.components.schemas[name]) : schema;
}

const operationOf = (one) => described.paths[`/call/${one.group}/${one.name}`]?.post;

function kindOf(state) {
  const answer = operationOf(state)?.responses["200"].content["application/json"].schema.properties.result;
  const fields = resolve(answer)?.properties ?? {};
  if ("position_rad" in fields) return Joint;
  if ("width_m" in fields) return Gripper;
  return "positions_rad" in fields ? Arm : null;
}

let looking = Promise.resolve();

/** Look what is there, one look after the other. */
function lookAround() {
  looking = looking.catch(() => {}).then(lookOnce);
  return looking;
}

async function lookOnce() {
  [services, described] = await Promise.all([door.get("/services"), door.get("/openapi.json")]);
  showServices();
  const groups = new Map();
  for (const one of services) {
    if (!groups.has(one.group)) groups.set(one.group, new Map());
    groups.get(one.group).set(one.name, one);
  }
  $("groups").replaceChildren(...[...groups.keys()].sort().map((group) => make("option", { value: group })));
  const now = JSON.stringify(services.map((one) => [one.container, one.group, one.name, one.allowed]).sort());
  if (now === shape) return;
  shape = now;
  await arrange(groups);
}

async function arrange(groups) {
  releaseAll();
  for (const device of devices.values()) device.leave();
  devices.clear();
  const members = new Map();
  for (const [group, inside] of groups) {
    const kind = inside.has("state") ? kindOf(inside.get("state")) : null;
    if (kind) devices.set(group, new kind(group, inside));
    else if (inside.has("joints")) members.set(group, await door.call(group, "joints").catch(() => []));
  }
  const robots = new Map();
  for (const group of devices.keys()) {
    const name = group.split(".")[0];
    robots.set(name, [...(robots.get(name) ?? []), group]);
  }
  chains = [];
  const shown = [...robots].sort().map(([name, inside]) => robotCard(name, inside, members));
  $("robot-list").replaceChildren(...(shown.length ? shown : [make("p", { class: "note" }, "No robot is there, or none that you may see.")]));
  followAll([...devices.values()]);
}

/** One after the other: a client may ask for 16 things at once. */
async function followAll(all) {
  for (const device of all) await device.follow();
}

function robotCard(name, groups, members) {
  const left = new Set(groups);
  const parts = [];
  for (const [group, joints] of [...members].sort()) {
    const inside = joints.filter((joint) => left.delete(joint)).map((joint) => devices.get(joint));
    if (inside.length) parts.push(part(group, inside, chainsOf(inside)));
  }
  for (const group of [...left].sort()) {
    const device = devices.get(group);
    parts.push(part(group, [device], device instanceof Arm ? [[device]] : []));
  }
  return make("article", { class: "robot", "aria-label": `Robot ${name}` }, make("h3", {}, name), ...parts);
}

function part(group, inside, sketched) {
  const made = sketched.map((joints) => new Chain(group, joints));
  chains.push(...made);
  for (const joints of sketched) joints.forEach((joint, place) => joints.length > 1 && write(joint.number, `${place + 1}`));
  const title = make("h4", { class: "group" }, group.split(".").slice(1).join(".") || group);
  const sketches = made.length ? make("div", { class: "sketches" }, ...made.map((chain) => chain.svg)) : null;
  const alone = inside.length === 1 && inside[0].group === group;
  return make("section", { class: "part" }, alone ? null : title, sketches, make("ul", { class: "devices" }, ...inside.map((one) => one.element)));
}

// --- e-stop

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

async function lookForEstops() {
  open_estops = await door.get("/estops");
  showEstops();
}

function showEstops() {
  const open = open_estops;
  show($("stopped"), JSON.stringify([open, said_of_estop, me?.administers]), () => [
    open.length ? make("strong", {}, "E-STOP: nothing moves until it is cleared.") : "",
    ...open.map((one) => make("p", {}, `${clock(one.at)} ${one.by}: ${one.reason}`)),
    said_of_estop ? make("p", {}, said_of_estop) : "",
    open.length && me?.administers ? button("Clear the e-stop", () => clearEstop(open)) : "",
    open.length && !me?.administers ? make("p", {}, "Who administers the system may clear it.") : "",
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
  if (event.key !== "Escape" || event.repeat || event.isComposing || !me) return;
  event.preventDefault();
  pressEstop();
}, true);

// --- services

const cards = new Map();

function showServices() {
  const wanted = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (one) => wanted.every((word) => `${one.group}.${one.name} ${one.doc}`.toLowerCase().includes(word));
  const found = services.filter(fits).sort((one, other) => keyOf(one).localeCompare(keyOf(other)));
  const shown = new Map();
  for (const one of found) {
    if (!shown.has(one.group)) shown.set(one.group, []);
    shown.get(one.group).push(serviceCard(one));
  }
  write($("service-count"), wanted.length ? `${found.length} of ${services.length} services` : `${services.length} services`);
  const groups = [...shown].map(([group, inside]) => make("details", { class: "service-group", "data-group": group, open: wanted.length > 0 }, make("summary", {}, group, " ", make("small", {}, `${inside.length}`)), ...inside));
  show($("service-list"), JSON.stringify([wanted, found]), () => {
    const open = new Set([...document.querySelectorAll(".service-group[open]")].map((one) => one.dataset.group));
    for (const group of groups) if (open.has(group.dataset.group)) group.open = true;
    return groups;
  });
}

const keyOf = (one) => `${one.group}.${one.name} ${one.container}`;

function serviceCard(one) {
  const [key, now] = [keyOf(one), JSON.stringify([one, operationOf(one)?.requestBody])];
  if (cards.get(key)?.now !== now) cards.set(key, { now, element: newCard(one) });
  return cards.get(key).element;
}

function newCard(one) {
  const effect = make("span", { class: "badge" }, one.effect);
  const health = one.health && one.health !== "healthy" ? make("span", { class: "badge bad" }, one.health) : null;
  const closed = one.allowed ? null : make("span", { class: "badge" }, "not for you");
  const summary = make("summary", {}, make("code", {}, one.name), " ", effect, closed, health);
  const card = make("details", { class: "service", "data-service": `${one.group}.${one.name}` }, summary);
  card.ontoggle = () => {
    if (card.open && card.childElementCount === 1) card.append(...formOf(one));
  };
  return card;
}

function formOf(one) {
  const body = operationOf(one)?.requestBody.content["application/json"].schema;
  const schema = resolve(body)?.properties.args.anyOf[0] ?? { properties: {} };
  const required = new Set(schema.required ?? []);
  const fields = Object.entries(schema.properties ?? {}).map(([name, inner]) => field(one, name, inner, required.has(name)));
  const result = make("output", { class: "result", role: "status" });
  const run = make("button", { type: "submit", disabled: !one.allowed }, one.effect === "read" ? "Read" : "Call");
  const cancel = button("Cancel", () => door.cancel(Number(cancel.dataset.call)), { hidden: true });
  const form = make("form", { class: "call" }, ...fields.map((each) => each.element), make("div", { class: "line" }, run, cancel), result);
  form.onsubmit = async (event) => {
    event.preventDefault();
    result.className = "result";
    try {
      const args = Object.fromEntries(fields.map((each) => [each.name, each.value()]).filter(([, value]) => value !== undefined));
      const asked = { do: "call", group: one.group, name: one.name, container: one.container, args, deadline_s: 60 };
      const { id, ended } = door.begin(asked, (told) => write(result, `… ${JSON.stringify(told.progress)}`));
      cancel.dataset.call = id;
      [cancel.hidden, run.disabled] = [false, true];
      write(result, "under way …");
      write(result, `→ ${JSON.stringify(await ended, null, 1)}`);
    } catch (error) {
      result.classList.add("bad");
      write(result, `✕ ${error.title ?? "Not sent"}: ${error.message}`);
    }
    [cancel.hidden, run.disabled] = [true, !one.allowed];
  };
  const where_ = make("p", { class: "note" }, `in ${one.container} on ${one.host}`);
  return [make("p", { class: "doc" }, one.doc), make("p", { class: "note" }, make("code", {}, one.signature)), where_, form];
}

/** One argument: a plain input where there is one for it, JSON otherwise. An empty one that may be left out is left out. */
function field(one, name, schema, required) {
  const kinds = (resolve(schema).anyOf ?? [resolve(schema)]).map(resolve).filter((kind) => kind.type !== "null");
  const kind = kinds.length === 1 ? kinds[0] : {};
  const id = `arg ${keyOf(one)} ${name}`.replaceAll(" ", "-");
  const common = { id, required, autocomplete: "off" };
  let input, value;
  if (kind.enum || kind.type === "boolean") {
    const options = kind.enum ?? [true, false];
    input = make("select", common, ...(required ? [] : [make("option", { value: "" }, "—")]), ...options.map((each) => make("option", { value: JSON.stringify(each) }, `${each}`)));
    value = () => JSON.parse(input.value);
  } else if (kind.type === "number" || kind.type === "integer") {
    const step = kind.type === "integer" ? "1" : "any";
    input = make("input", { ...common, type: "number", step, min: kind.minimum ?? "", max: kind.maximum ?? "" });
    value = () => Number(input.value);
  } else if (kind.type === "string") {
    input = make("input", { ...common, type: "text" });
    value = () => input.value;
  } else {
    input = make("textarea", { ...common, rows: 2, spellcheck: false, placeholder: kind.type === "array" ? "[…]" : "JSON" });
    value = () => JSON.parse(input.value);
  }
  const hint = schema.description ?? kind.description ?? "";
  const text = required ? name : `${name} (may be left out)`;
  const element = make("p", { class: "field" }, make("label", { for: id }, text), input, make("small", {}, hint));
  return { name, element, value: () => (input.value === "" && !required ? undefined : value()) };
}

$("search").oninput = showServices;

// --- locks

let locks = [];

const lockOn = (resources) => locks.find((one) => one.resources.some((name) => resources.includes(name)));

async function lookForLocks() {
  locks = await door.get("/locks");
  const mine = new Map([...door.locks].map(([lock, resources]) => [[...resources].sort().join(), lock]));
  const nameOf = (one) => mine.get([...one.resources].sort().join());
  const told = JSON.stringify([locks, [...door.locks.keys()]]);
  show($("lock-list"), told, () => (locks.length ? locks.map((one) => lockCard(one, nameOf(one))) : [make("li", { class: "note" }, "Nothing is locked.")]));
}

function lockCard(one, mine) {
  const asked = { resources: one.resources };
  const said = make("p", { role: "status" });
  const attempt = async (path, reason, done) => {
    try {
      await door.post(path, { ...asked, reason });
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
    ? [button("Give it back", () => door.unlock(mine).catch((error) => write(said, error.message)))]
    : [button("Ask for it", () => attempt("/locks/request", "asked from the dashboard", "Its owner was asked.")), begin];
  const lines = [
    ["Owner", mine ? `${one.owner} (this page)` : one.owner],
    ["Purpose", one.purpose || "—"],
    ["Since", clock(one.since)],
    ["Waiting", one.waiting.join(", ") || "nobody"],
  ];
  const figures = make("dl", { class: "figures" }, ...lines.map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text))));
  return make("li", { class: "card" }, make("h3", {}, one.resources.join(", ")), figures, make("div", { class: "line" }, ...hands), breaking, said);
}

$("lock-form").onsubmit = async (event) => {
  event.preventDefault();
  write($("lock-problem"), "");
  try {
    await door.lock($("lock-group").value, $("lock-purpose").value, 2);
  } catch (error) {
    write($("lock-problem"), `✕ ${error.title}: ${error.message}`);
  }
};

// --- containers, notifications, hooks, log

function table(element, caption, columns, rows, none) {
  show(element, JSON.stringify(rows), () => {
    if (!rows.length) return [make("p", { class: "note" }, none)];
    const head = make("tr", {}, ...columns.map((name) => make("th", { scope: "col" }, name)));
    const lines = rows.map(([first, ...rest]) => make("tr", {}, make("th", { scope: "row" }, first), ...rest.map((text) => make("td", {}, text))));
    const whole = make("table", {}, make("caption", {}, caption), make("thead", {}, head), make("tbody", {}, ...lines));
    return [make("div", { class: "wide", tabindex: 0, role: "region", "aria-label": caption }, whole)];
  });
}

const told = (value, digits, unit) => (value === null || value === undefined ? "—" : `${value.toFixed(digits)} ${unit}`.trim());

async function lookAtContainers() {
  const [there, loads] = await Promise.all([door.get("/containers"), door.get("/loads")]);
  const busy = new Map(loads.map((one) => [one.container, one]));
  const rows = there.sort((one, other) => one.name.localeCompare(other.name)).map((one) => {
    const load = busy.get(one.name);
    const memory = load?.memory_bytes;
    return [
      one.name, one.identity, one.host, told(load?.cpu_percent, 0, "%"), told(load?.host_cpu_percent, 0, "%"),
      memory ? `${(memory / 1e6).toFixed(0)} MB` : "—", told(load?.calls_per_s, 1, "/s"), told(load?.in_flight, 0, ""),
    ];
  });
  table($("container-list"), "Containers, over the last second", ["Container", "Identity", "Host", "CPU", "Host’s CPU", "Memory", "Calls", "Running"], rows, "No container is there.");
}

async function lookAtWatchers() {
  if (!me.reads) {
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

let log = null;

function readLog() {
  if (log) door.cancel(log.id);
  $("log-lines").replaceChildren();
  write($("log-problem"), "");
  const reading = door.begin({ do: "logs", level: Number($("level").value) }, ({ line }) => {
    if (reading !== log) return;
    const [kind, name] = line.level >= 40 ? ["bad", "error"] : line.level >= 30 ? ["warn", "warning"] : ["", line.level >= 20 ? "info" : "debug"];
    $("log-lines").prepend(make("li", { class: kind }, make("time", {}, clock(line.at)), ` ${name} ${line.container}: ${line.text}`));
    while ($("log-lines").childElementCount > MOST_LINES) $("log-lines").lastChild.remove();
  });
  log = reading;
  reading.ended.catch((error) => reading === log && door.connected && write($("log-problem"), `${error.title}: ${error.message}`));
}

$("level").onchange = readLog;

// --- coming and going

/** Ask again and again while connected and visible. Whoever answers nothing is gone. */
async function keepAsking(look, every_ms) {
  for (;;) {
    if (door.connected && document.visibilityState === "visible") {
      try {
        await look();
      } catch (error) {
        if (error.name === "TimeoutError" || error.name === "TypeError") door.drop();
        else tell(`${error.title ?? error.name}: ${error.message}`);
      }
    }
    await sleep(every_ms);
  }
}

let changed = 0;

function onChange() {
  clearTimeout(changed);
  changed = setTimeout(() => lookAround().catch((error) => tell(error.message)), 300);
}

function showConnection(connected) {
  write($("link"), connected ? "● Connected" : "✕ Not connected: what you see is old. Trying again …");
  write($("who"), me ? `as ${me.identity}` : "");
  document.body.classList.toggle("offline", !connected);
  $("leave").hidden = !door.token;
}

/** Wait for a token. */
async function signIn(error) {
  [$("inside").hidden, $("login").hidden] = [true, false];
  write($("link"), "Not signed in");
  write($("who"), "");
  document.body.classList.remove("offline");
  write($("login-problem"), door.token ? error.message : "");
  $("token").focus();
  await new Promise((done) => {
    $("login-form").onsubmit = (event) => {
      event.preventDefault();
      door.token = $("token").value.trim();
      $("token").value = "";
      done();
    };
  });
  sessionStorage.setItem("token", door.token);
}

$("leave").onclick = () => {
  sessionStorage.removeItem("token");
  location.reload();
};

async function main() {
  let pause_ms = 250;
  for (;;) {
    try {
      me = await door.get("/me");
      const { closed } = await door.open();
      [$("inside").hidden, $("login").hidden] = [false, true];
      showConnection(true);
      pause_ms = 250;
      shape = "";
      door.begin({ do: "watch" }, onChange).ended.catch(() => {});
      if (me.reads) readLog();
      else write($("log-problem"), "It is for who may read the system (group trade).");
      lookAround().catch((error) => tell(error.message));
      await closed;
    } catch (error) {
      if (error.status === 401 || error.status === 403) {
        me = null;
        await signIn(error);
        continue;
      }
    }
    if (me) showConnection(false);
    await sleep(pause_ms);
    pause_ms = Math.min(pause_ms * 2, LONGEST_PAUSE_MS);
  }
}

setInterval(paintAll, 1000 / STATE_HZ);
keepAsking(lookForEstops, ASK_AGAIN_MS);
keepAsking(lookForLocks, ASK_AGAIN_MS);
keepAsking(lookAtContainers, 4 * ASK_AGAIN_MS);
keepAsking(lookAtWatchers, 3 * ASK_AGAIN_MS);
main();
