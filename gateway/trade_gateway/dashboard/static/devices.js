// A joint, a gripper or an arm: its last measurement, and its controls.

import { gateway } from "./gateway.js";
import { JOG_VALID_S, Jog } from "./jog.js";
import { lockOn } from "./locks.js";
import { button, degrees, draw, fixed, make, show, sleep, write } from "./page.js";

export const STATE_HZ = 5;
const STALE_MS = 1500;
const ASK_AGAIN_MS = 1000;
const ACTION_S = 60;
const MOST_LEAD_S = 1; // longest lead of a goal over the measurement

/** The device behind the services of a group, and its last measurement. */
class Device {
  present = true; // on this page
  outdated = false; // of an earlier connection, and about to be replaced
  state = null;
  limits = null;
  problem = "";
  busy = Promise.resolve();
  jogs = [];
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

  /** Follow its state while it is on this page; resolves after the first message. */
  follow() {
    return new Promise((first) => this.#follow(first));
  }

  async #follow(first) {
    while (this.present && gateway.connected) {
      try {
        if (this.services.has("limits")) this.limits ??= await gateway.call(this.group, "limits");
        this.write_speed();
        const stream = { do: "stream", group: this.group, name: "state", hz: STATE_HZ };
        const { id, ended } = gateway.begin(stream, (message) => {
          this.#heard(message);
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

  #heard(message) {
    this.problem = message.failed ? message.failed.detail : "";
    if (!message.sample) return;
    this.state = message.sample.value;
    this.#heard_at = performance.now();
  }

  leave() {
    this.present = false;
    gateway.cancel(this.#stream);
    this.element.remove();
  }

  async stop() {
    try {
      await gateway.call(this.group, "stop", {}, { deadline_s: 5 });
    } catch (error) {
      if (error.title !== "Cancelled") this.refused(error);
    }
  }

  say(text) {
    write(this.message, text);
    this.resume.hidden = true;
  }

  /** Call a service without arguments. Its motion ends with this page, like all of its motion. */
  async act(name) {
    this.say("");
    try {
      await gateway.act(this.group, name, {}, { deadline_s: ACTION_S });
    } catch (error) {
      this.refused(error);
    }
  }

  refused(error) {
    const known = error.title === "DeviceFault" && this.state?.fault && error.message.includes(this.state.fault);
    const cure = this.actions.get(this.constructor.cure)?.textContent;
    if (known && cure) this.say(`That fault is in the way. When its cause is gone: ${cure}.`);
    else this.say(`${error.title}: ${error.message}`);
    this.resume.hidden = error.title !== "Stopped";
  }

  /** Resume under a lock, as this needs the lock, or the right to administer the joint. */
  async let_move_again() {
    let lock = "";
    try {
      if (!gateway.has_locked(this.resources)) lock = await gateway.lock(this.group, "let it move again", 0.5);
      await gateway.ask({ do: "resume", group: this.group });
      this.say("It may move again.");
    } catch (error) {
      this.refused(error);
    }
    if (lock && gateway.connected) await gateway.unlock(lock).catch((error) => this.refused(error));
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
    const offered = this.constructor.offers.filter(([name]) => this.services.has(name));
    this.actions = new Map(offered.map(([name, text]) => [name, this.action(name, text)]));
    this.number = make("span", { class: "number" });
    const title = make("h4", {}, this.number, this.name);
    const notes = make("div", { class: "notes", tabindex: 0, "aria-label": `Notes on ${this.name}`, role: "group" }, this.trouble, this.message, this.resume);
    const owner = make("p", { class: "owner" }, this.locked);
    const actions = this.actions.size ? make("div", { class: "actions" }, ...this.actions.values()) : null;
    const parts = [title, this.badges, this.picture(), this.figures, owner, this.hands, actions, notes];
    return make("li", { class: "device", id: `at-${this.group}` }, ...parts);
  }

  action(name, text) {
    const about = this.services.get(name).doc.split("\n\n")[0];
    return button(text, () => this.act(name), { "aria-label": `${text} ${this.name}`, title: about });
  }

  picture() {
    return null;
  }

  write_speed() {
    if (this.limits) for (const jog of this.jogs) jog.write_speed();
  }

  paint() {
    const usable = gateway.connected && !this.outdated;
    for (const jog of this.jogs) jog.let(this.limits && this.may(this.constructor.moved_by) && usable);
    for (const [name, action] of this.actions) action.disabled = !(this.may(name) && usable);
    this.stopping.disabled = !gateway.connected;
    const { state } = this;
    const silent = this.problem || (state ? this.stale && "not heard of lately" : "no data yet");
    const wrong = [silent, state?.fault && `fault: ${state.fault}`].filter(Boolean).join("; ");
    write(this.trouble, wrong && `✕ ${wrong}`);
    const words = state ? this.words(state) : [];
    show(this.badges, JSON.stringify(words), () => words.map((text) => make("span", { class: "badge" }, text)));
    const lock = lockOn(this.resources);
    write(this.locked, lock ? `Locked by ${lock.owner}, ${lock.purpose}` : "Not locked");
    this.element.classList.toggle("stale", !state || this.stale || !gateway.connected);
    if (!state) return;
    const figures = this.measured(state);
    if (this.figures.childElementCount !== figures.length) {
      this.figures.replaceChildren(...figures.map(([name]) => make("div", {}, make("dt", {}, name), make("dd"))));
    }
    figures.forEach(([, text], place) => write(this.figures.children[place].lastChild, text));
  }

  words(state) {
    const closed = this.jogs.length && !this.may(this.constructor.moved_by) ? ["⊘ look only"] : [];
    return [state.moving ? "▶ moving" : "■ at rest", ...closed];
  }

  measured() {
    return [];
  }
}

export class Joint extends Device {
  static offers = [["enable", "Enable"]];
  static cure = "enable";
  static moved_by = "set_velocity";

  picture() {
    this.mark = draw("rect", { class: "mark", y: 0, width: 2.4, height: 10, rx: 1.2 });
    this.zero = draw("rect", { class: "zero", y: 2, width: 0.6, height: 6 });
    const track = draw("rect", { class: "track", y: 3, width: 100, height: 4, rx: 2 });
    this.bar = draw("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", role: "meter" }, track, this.zero, this.mark);
    this.bar.setAttribute("aria-label", `Position of ${this.name}`);
    [this.least, this.most] = [make("span"), make("span")];
    this.jogs = this.services.has("set_velocity") ? [-1, 1].map((sign) => new Jog(this, this.name, sign)) : [];
    this.hands.prepend(...this.jogs.map((jog) => jog.button));
    return make("div", { class: "range" }, this.least, this.bar, this.most);
  }

  get joint_limits() {
    return [this.limits];
  }

  setpoints(jog) {
    return () => ["set_velocity", { velocity_rad_s: jog.sign * jog.speed_rad_s }];
  }

  words(state) {
    return [...super.words(state), state.enabled ? "● torque on" : "○ torque off"];
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

export class Gripper extends Device {
  static offers = [["open", "Open"], ["close", "Close"], ["activate", "Activate"], ["clear_fault", "Clear fault"]];
  static cure = "activate";

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

export class Arm extends Device {
  static offers = [["power_on", "Power on"], ["release_brakes", "Release brakes"], ["unlock_protective_stop", "Unlock protective stop"]];
  static moved_by = "servo";

  /** A row for each joint, once it is known how many there are. */
  show_jogs() {
    const names = this.joint_limits.map((_, place) => `joint ${place + 1} of ${this.name}`);
    const rows = names.map((name, place) => [-1, 1].map((sign) => new Jog(this, name, sign, place)));
    this.jogs = rows.flat();
    this.hands.before(...rows.map((row, place) => make("div", { class: "hands" }, make("span", {}, `${place + 1}`), ...row.map((jog) => jog.button))));
    this.write_speed();
  }

  get joint_limits() {
    return this.limits.joints;
  }

  /** Angles for all joints; one advances with time from the arm's position, and never far ahead of it. */
  setpoints(jog) {
    const { sign, place } = jog;
    const { min_rad, max_rad } = this.joint_limits[place];
    const goal = [...this.state.positions_rad];
    let before_ms = performance.now();
    return () => {
      const now_ms = performance.now();
      const step_rad = jog.speed_rad_s * Math.min((now_ms - before_ms) / 1000, JOG_VALID_S);
      before_ms = now_ms;
      const ahead_rad = sign * (goal[place] - this.state.positions_rad[place]);
      const left_rad = sign < 0 ? goal[place] - min_rad : max_rad - goal[place];
      goal[place] += sign * Math.max(0, Math.min(step_rad, jog.speed_rad_s * MOST_LEAD_S - ahead_rad, left_rad));
      return ["servo", { positions_rad: goal }];
    };
  }

  paint() {
    if (this.limits && !this.jogs.length && this.services.has("servo")) this.show_jogs();
    super.paint();
    if (!this.state || this.stale) for (const jog of this.jogs) jog.let(false); // its position is unknown
  }

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
