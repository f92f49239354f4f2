// A question before a change: what will happen, and to what. It stays in the page, as Esc is the e-stop.

import { LONG_MS } from "./gateway.js";
import { button, make, write } from "./page.js";

/** Say the outcome of a change. */
export function said(element, text) {
  write(element.querySelector("output") ?? element.appendChild(make("output", { role: "status" })), text);
}

/**
 * Ask in an element; without a question, withdraw the earlier one.
 * `fields` are `[name, label, choices]`, without choices a text; `text` is a sentence, or makes one of the fields' values.
 */
export function confirmed(element, question = null) {
  if (!question) {
    element.replaceChildren();
    return;
  }
  const { title, text, fields = [], act } = question;
  const inputs = fields.map(([name, label, choices]) => {
    const input = choices ? make("select", {}, ...choices.map((one) => make("option", { value: one }, one))) : make("input", { autocomplete: "off", spellcheck: false, required: name !== "group" });
    return { name, input, element: make("label", {}, label, " ", input) };
  });
  const given = () => Object.fromEntries(inputs.map((one) => [one.name, one.input.value]));
  const what = make("p", { class: "consequence" });
  const outcome = make("output", { role: "status" });
  const yes = make("button", { type: "submit" }, title);
  const no = button("Leave it as it is", () => confirmed(element));
  const form = make("form", { class: "confirm", "aria-label": title }, ...inputs.map((one) => one.element), what, make("div", { class: "line" }, yes, no));
  const say = () => write(what, typeof text === "string" ? text : text(given()));
  form.oninput = say;
  say();
  form.onsubmit = async (event) => {
    event.preventDefault();
    yes.disabled = no.disabled = true;
    write(outcome, "…");
    try {
      write(outcome, `✓ ${await act(given())}`);
      form.remove();
    } catch (error) {
      write(outcome, error.name === "TimeoutError" ? `✕ There was no answer within ${LONG_MS / 1000} s: it may have been done.` : `✕ ${error.title ?? error.name}: ${error.message}`);
      yes.disabled = no.disabled = false;
    }
  };
  element.replaceChildren(form, outcome);
  (inputs[0]?.input ?? yes).focus();
}
