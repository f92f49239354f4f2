// All services: search, and a form for each, made from its schema.

import { gateway } from "./gateway.js";
import { $, button, make, show, write } from "./page.js";
import { operationOf, resolve, services } from "./schemas.js";

const cards = new Map();

export function showServices() {
  const wanted = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const textOf = (one) => `${one.group}.${one.name} ${one.doc} ${one.needs.join(" ")} ${one.achieves.join(" ")}`.toLowerCase();
  const fits = (one) => wanted.every((word) => textOf(one).includes(word));
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
  const schema = resolve(body)?.properties.args ?? { properties: {} };
  const required = new Set(schema.required ?? []);
  const fields = Object.entries(schema.properties ?? {}).map(([name, inner]) => field(one, name, inner, required.has(name)));
  const result = make("output", { class: "result", role: "status" });
  const run = make("button", { type: "submit", disabled: !one.allowed }, one.effect === "read" ? "Read" : "Call");
  const cancel = button("Cancel", () => gateway.cancel(Number(cancel.dataset.call)), { hidden: true });
  const form = make("form", { class: "call" }, ...fields.map((each) => each.element), make("div", { class: "line" }, run, cancel), result);
  form.onsubmit = async (event) => {
    event.preventDefault();
    result.className = "result";
    try {
      const args = Object.fromEntries(fields.map((each) => [each.name, each.value()]).filter(([, value]) => value !== undefined));
      const asked = { do: "call", group: one.group, name: one.name, container: one.container, args, deadline_s: 60 };
      const { id, ended } = gateway.begin(asked, (message) => write(result, `… ${JSON.stringify(message.progress)}`), one.effect !== "read");
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
  const doc = make("p", { class: "doc" }, one.doc);
  return [doc, make("p", { class: "note" }, make("code", {}, one.signature)), ...conditionsOf(one), where_, form];
}

/** Its pre- and post-conditions: a line for each kind that it has. */
function conditionsOf(one) {
  const known = Object.entries({ needs: one.needs, achieves: one.achieves }).filter(([, texts]) => texts.length);
  return known.map(([word, texts]) => make("p", { class: "note" }, `${word} ${texts.join(", ")}`));
}

/** One argument: a plain input if there is one for its type, JSON otherwise. An empty optional one is omitted. */
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
