// Hold to move.

import { gateway } from "./gateway.js";
import { $, make, sleep, write } from "./page.js";

const JOG_EVERY_MS = 80;
export const JOG_VALID_S = 0.2; // validity of a set-point: motion ends then, whatever happens to this page

const held = new Set();

export function releaseAll() {
  for (const jog of [...held]) jog.release();
}

/**
 * One direction of one joint of a device. It moves while it is held and this page is visible, by set-points that end by
 * themselves: the device says which service takes them, and how fast the joint would turn.
 */
export class Jog {
  #moving = false;
  #stopped = Promise.resolve();

  constructor(device, name, sign, place = 0) {
    this.device = device;
    this.sign = sign;
    this.place = place; // among the joints of the device
    const way = sign < 0 ? "negative" : "positive";
    const label = `Hold to turn ${name} in the ${way} direction`;
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
      if (event.detail === 0 && !this.pressed) this.device.say("Hold Space or Enter to move.");
    };
  }

  get pressed() {
    return held.has(this);
  }

  get speed_rad_s() {
    return (this.device.joint_limits[this.place].max_speed_rad_s * Number($("speed").value)) / 100;
  }

  write_speed() {
    write(this.button.lastChild, `${this.speed_rad_s.toFixed(3)} rad/s`);
  }

  /** Whether it may be held; when it may not any more, it is released. */
  let(allowed) {
    this.button.disabled = !allowed;
    if (!allowed) this.release();
  }

  press() {
    if (this.pressed || this.button.disabled || document.visibilityState !== "visible" || !gateway.connected) return;
    held.add(this);
    this.button.setAttribute("aria-pressed", "true");
    this.device.say("");
    this.device.busy = this.device.busy.then(() => this.#run());
  }

  release() {
    if (!held.delete(this)) return;
    this.button.setAttribute("aria-pressed", "false");
    if (this.#moving) this.#stopped = this.device.stop();
  }

  async #run() {
    if (!this.pressed) return;
    const { group, resources } = this.device;
    let lock = "";
    try {
      if (!gateway.has_locked(resources)) lock = await gateway.lock(group, "jog by hand", 0.5);
      const setpoint = this.device.setpoints(this);
      while (this.pressed) {
        this.#moving = true;
        const next = sleep(JOG_EVERY_MS);
        const [name, args] = setpoint();
        await gateway.act(group, name, { ...args, valid_s: JOG_VALID_S }, { deadline_s: 1 }); // one at a time: none piles up on a slow link
        await next;
      }
    } catch (error) {
      if (this.pressed) this.device.refused(error);
    } finally {
      this.release();
      this.#moving = false;
      await this.#stopped;
      if (lock && gateway.connected) await gateway.unlock(lock).catch((error) => this.device.refused(error));
    }
  }
}

addEventListener("blur", releaseAll);
addEventListener("pagehide", releaseAll);
document.addEventListener("visibilitychange", releaseAll);
gateway.on_loss = releaseAll;
