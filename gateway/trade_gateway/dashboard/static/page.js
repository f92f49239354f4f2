// Elements of the page, and how things are said on it. Text is only ever set as text.

const SHOWN_FOR_MS = 10000;

export const $ = (id) => document.getElementById(id);
export const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** An element; strings and numbers are attributes, anything else a property. */
export function make(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (typeof value === "string" || typeof value === "number") made.setAttribute(name, value);
    else if (value !== undefined) made[name] = value;
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export function draw(tag, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

export const button = (text, onclick, properties = {}) => make("button", { type: "button", onclick, ...properties }, text);

/** Set a text if it differs: screen readers do not read an unchanged one again. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Replace children if their key differs. */
export function show(element, key, children) {
  if (element.dataset.shown === key) return;
  element.dataset.shown = key;
  element.replaceChildren(...children());
}

export const fixed = (value, digits) => (value >= 0 ? "+" : "−") + Math.abs(value).toFixed(digits);
export const degrees = (rad) => `${fixed((rad * 180) / Math.PI, 1)}°`;
export const moment = (seconds) => new Date(seconds * 1000).toLocaleString();
export const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString();

let hiding = 0;

/** Show a message for a short time. */
export function tell(text) {
  write($("notice"), text);
  clearTimeout(hiding);
  hiding = setTimeout(() => write($("notice"), ""), SHOWN_FOR_MS);
}

/** A table; a cell is a text, or what a button says and does: `{ label, act, name, why }`; `why`: not now. Without rows, a sentence. */
export function table(element, caption, columns, rows, none) {
  show(element, JSON.stringify([rows, none]), () => {
    if (!rows.length) return [make("p", { class: "note" }, none)];
    const head = make("tr", {}, ...columns.map((name) => make("th", { scope: "col" }, name)));
    const lines = rows.map(([first, ...rest]) => make("tr", {}, make("th", { scope: "row" }, first), ...rest.map((cell) => make("td", {}, cellOf(cell)))));
    const whole = make("table", {}, make("caption", {}, caption), make("thead", {}, head), make("tbody", {}, ...lines));
    return [make("div", { class: "wide", tabindex: 0, role: "region", "aria-label": caption }, whole)];
  });
}

const cellOf = (cell) => (typeof cell === "string" ? cell : button(cell.label, cell.act, { "aria-label": cell.name, disabled: Boolean(cell.why), title: cell.why ?? "" }));

export const measure = (value, digits, unit) => (value === null || value === undefined ? "—" : `${value.toFixed(digits)} ${unit}`.trim());
