// Editors of the policy and of rules: a changed text is tried first, with a diff, and only the tried text can be saved.

import { LONG_MS, gateway } from "./gateway.js";
import { $, button, make, show, write } from "./page.js";

let files = []; // what can be edited: { title, path, read, test, put, note }

const POLICY = {
  title: "policy",
  path: "/policy/file",
  test: "/policy/test",
  read: () => gateway.get("/policy/file", LONG_MS),
  note: "Saving replaces the policy file of this HTTP gateway. Containers that use the same file apply it within two seconds. On other hosts, copy it there.",
};

const rulesIn = (container) => ({
  title: `rules in ${container}`,
  path: `/rules/${encodeURIComponent(container)}`,
  test: `/rules/${encodeURIComponent(container)}/test`,
  read: async () => (await gateway.get("/rules", LONG_MS)).find((one) => one.container === container),
  note: `Saving replaces the rules file of ${container}, which applies it within a second. Rules run with the rights of ${container}.`,
});

/** The buttons that open an editor; disabled without the right, which the text beside them names. */
export function showEditors(governed, containers) {
  files = [...(governed ? [POLICY] : []), ...containers.map(rulesIn)];
  const may = gateway.me.administers;
  write($("edit-rights"), may || !files.length ? "" : `Changing them needs the right to administer the system (group trade), which ${gateway.me.identity} does not have.`);
  show($("edit-buttons"), JSON.stringify([may, files.map((one) => one.title)]), () => files.map((one) => button(`Edit ${one.title} …`, () => edit(one), { disabled: !may, "aria-describedby": "edit-rights" })));
}

const failed = (error) => `✕ ${error.title ?? error.name}: ${error.message}`;

async function edit(file) {
  const place = $("editor");
  const outcome = make("output", { role: "status" });
  place.replaceChildren(outcome);
  let shown;
  try {
    shown = await file.read();
  } catch (error) {
    write(outcome, failed(error));
    return;
  }
  const area = make("textarea", { id: "edited", rows: Math.min(24, shown.text.split("\n").length + 3), spellcheck: false });
  area.value = shown.text;
  const effects = make("div", { class: "effects" });
  const save = button(`Save ${file.title}`, () => saved(), { disabled: true });
  const attempt = make("button", { type: "submit" }, "Try it");
  const close = button("Leave it as it is", () => place.replaceChildren());
  const form = make("form", { class: "confirm", "aria-label": `Edit ${file.title}` }, make("label", { for: "edited" }, shown.path), area, make("p", { class: "note" }, file.note), make("div", { class: "line" }, attempt, save, close), outcome, effects);
  let tried = null;
  area.oninput = () => (save.disabled = area.value !== tried);
  form.onsubmit = async (event) => {
    event.preventDefault();
    const text = area.value;
    write(outcome, "…");
    try {
      const trial = await gateway.post(file.test, { text });
      effects.replaceChildren(...trialOf(trial));
      tried = trial.problem || !trial.diff.length ? null : text;
      write(outcome, trial.problem ? `✕ It would be refused: ${trial.problem}` : trial.diff.length ? "✓ It is valid. Nothing is saved yet." : "Nothing differs.");
    } catch (error) {
      tried = null;
      write(outcome, failed(error));
    }
    save.disabled = area.value !== tried;
  };
  const saved = async () => {
    write(outcome, "…");
    try {
      const { text } = await gateway.request("PUT", file.path, { text: tried, version: shown.version }, LONG_MS);
      place.replaceChildren(outcome);
      write(outcome, `✓ ${text}`);
    } catch (error) {
      write(outcome, failed(error));
    }
  };
  place.replaceChildren(form);
  area.focus();
}

function trialOf({ diff, effects }) {
  const kinds = { "+": "added", "-": "removed", "@": "place" };
  const lines = diff.slice(2).map((line) => make("span", { class: kinds[line[0]] ?? "" }, `${line}\n`));
  return [
    effects.length ? make("ul", { class: "bullets" }, ...effects.map((one) => make("li", {}, one))) : null,
    lines.length ? make("pre", { class: "result diff", tabindex: 0, role: "region", "aria-label": "Lines that differ" }, ...lines) : null,
  ].filter(Boolean);
}
