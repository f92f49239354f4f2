// The connection to the HTTP gateway: requests, and the WebSocket with its operations. docs/http.md specifies the other side.

import { sleep, tell } from "./page.js";

const ESTOP_WITHIN_MS = 1000;
const SILENT_MS = 3000; // a gateway that is silent for so long counts as gone
export const LONG_MS = 15000; // for requests that wait for other containers

/** A refusal by the gateway or the system, with its problem. */
export class Refused extends Error {
  constructor(problem) {
    super(problem.detail || problem.title);
    this.title = problem.title;
    this.status = problem.status;
    this.data = problem.data;
  }
}

const lost = () => new Refused({ title: "NotConnected", status: 0, detail: "There is no connection to the HTTP gateway." });

class Gateway {
  token = sessionStorage.getItem("token") || "";
  me = null; // the identity that is signed in, and its rights over the system
  locks = new Map(); // those of this page: name -> resources
  on_loss = () => {}; // called when a lock or the connection is lost
  #socket = null;
  #under_way = new Map();
  #number = 0;

  get connected() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Whether a call of this page that may move something is under way. */
  get acting() {
    return [...this.#under_way.values()].some((one) => one.acts);
  }

  async request(method, path, body, within_ms) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
    if (body) headers["Content-Type"] = "application/json";
    const options = { method, headers, body: body && JSON.stringify(body), cache: "no-store" };
    const answer = await fetch(path, { ...options, signal: AbortSignal.timeout(within_ms) });
    const content = await answer.json();
    if (!answer.ok) throw new Refused(content);
    return content;
  }

  get(path, within_ms = SILENT_MS) {
    return this.request("GET", path, undefined, within_ms);
  }

  post(path, body) {
    return this.request("POST", path, body, LONG_MS);
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
    this.on_loss();
    for (const { reject } of this.#under_way.values()) reject(lost());
    this.#under_way.clear();
  }

  #hear(message) {
    if (message.event === "lock_lost") {
      this.locks.delete(message.lock);
      this.on_loss();
      tell(`A lock was lost: ${message.problem.detail}`);
      return;
    }
    const waiting = this.#under_way.get(message.id);
    if (!waiting) return;
    if (!("result" in message) && !("problem" in message)) {
      waiting.heard(message);
      return;
    }
    this.#under_way.delete(message.id);
    if ("problem" in message) waiting.reject(new Refused(message.problem));
    else waiting.resolve(message.result);
  }

  /** Begin an operation; `heard` gets its messages, `ended` its result. `acts`: whether it may move something. */
  begin(message, heard = () => {}, acts = false) {
    const id = ++this.#number;
    const ended = new Promise((resolve, reject) => {
      if (!this.connected) {
        reject(lost());
        return;
      }
      this.#under_way.set(id, { resolve, reject, heard, acts });
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

  /** The same for a service that may move something. */
  act(group, name, args, options) {
    return this.begin({ do: "call", group, name, args, ...options }, undefined, true).ended;
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

  /** Stop everything: over the socket, and without an answer in time, by a separate request. */
  async estop(reason) {
    const stopped = this.connected ? this.ask({ do: "estop", reason }).catch(() => null) : null;
    return (await Promise.race([stopped, sleep(stopped ? ESTOP_WITHIN_MS : 0)])) ?? this.post("/estop", { reason });
  }
}

export const gateway = new Gateway();
