// API keys, for administrators: who has one, what each may do, a new one, and an end to one.

import { copyButton, h, say, when } from "./dom.js";
import { service } from "./service.js";

const ROLES = [["localize", "localize, and its jobs"], ["read", "read"], ["admin", "admin"]];
const ENDS = [["", "never"], ["1", "after 1 day"], ["7", "after 7 days"], ["30", "after 30 days"], ["365", "after a year"],
  ["date", "on a date"]];
const DAY_MS = 86_400_000;
const HEADS = ["Name", "Role", "Scenes", "Rate limit", "Of the queue", "Ends", "Made", "Actions"];

export function show(main) {
  document.title = "API keys – splatfix";
  const rows = h("tbody");
  const note = h("p", { class: "trouble", role: "alert", hidden: true });
  const made = h("div", { class: "sendbox", hidden: true });
  const told = error => { note.hidden = !error; note.textContent = error?.message ?? ""; };

  const load = async () => {
    const own = await service.ownKey();
    rows.replaceChildren(...(await service.keys()).map(key => row(key, key.name === own.name, async button => {
      if (!confirm(`Revoke the key ${key.name}? Its sessions and share links end at once.`)) return;
      button.disabled = true;
      await service.removeKey(key.name);
      say(`${key.name} was revoked`);
      await load();
    }, told)));
  };

  main.append(h("h1", {}, "API keys"), note, made,
    h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Keys" }, h("table", { class: "keys" },
      h("thead", {}, h("tr", {}, HEADS.map(name => h("th", { scope: "col" }, name)))), rows)),
    newKey(async (name, what) => {
      told(null);
      const { key } = await service.addKey(name, what);
      made.replaceChildren(...shown(name, key));
      made.hidden = false;
      made.querySelector("button").focus();
      await load();
    }, told));
  load().catch(told);
}

function row(key, isOwn, revoke, told) {
  const button = h("button", { type: "button", class: "plain", "aria-label": `Revoke ${key.name}` }, "Revoke");
  button.addEventListener("click", () => revoke(button).catch(error => { button.disabled = false; told(error); }));
  const ends = key.expires ? `${key.expired ? "ended " : ""}${when(key.expires)}` : "never";
  const cells = [key.role, key.scenes?.join(", ") ?? "all", key.rate ?? "the service's",
    key.queue_share === null ? "all" : `${Math.round(100 * key.queue_share)} %`,
    key.temporary ? "with this run" : ends, key.created ? when(key.created) : "–",
    isOwn ? "your key" : h("span", { class: "actions" }, button)];
  return h("tr", { class: key.expired ? "ended" : null }, h("th", { scope: "row" }, key.name),
    cells.map((cell, index) => h("td", { "data-head": HEADS[index + 1] }, cell)));
}

/** The new key, which no later answer of the service has. */
function shown(name, key) {
  return [
    h("p", {}, h("strong", {}, `The key ${name} is made. `), "Copy it now: it is not shown again."),
    h("p", { class: "buttons" }, h("code", { class: "newkey" }, key), copyButton(() => key, "the key")),
  ];
}

function newKey(make, told) {
  const name = h("input", { required: true, maxLength: 64, autocomplete: "off", pattern: "[A-Za-z0-9][\\w .@\\-]{0,63}", title: "Letters, digits, spaces and _ . @ -" });
  const role = select(ROLES);
  const scenes = h("input", { autocomplete: "off", placeholder: "all", "aria-describedby": "scenes-help" });
  const rate = h("input", { autocomplete: "off", placeholder: "the service's", pattern: "[1-9]\\d{0,5}/(second|minute|hour|day)", title: "As 10/second, 600/minute, 1000/day" });
  const share = h("input", { type: "number", min: 1, max: 100, placeholder: "100" });
  const ends = select(ENDS);
  const date = h("input", { type: "date", min: new Date(Date.now() + DAY_MS).toISOString().slice(0, 10), hidden: true, "aria-label": "Date on which it ends" });
  const settle = () => {
    date.hidden = ends.value !== "date";
    date.required = ends.value === "date";
    scenes.disabled = role.value === "admin";
  };
  for (const control of [ends, role]) control.addEventListener("change", settle);
  const form = h("form", { class: "options", "data-needs": "admin" }, h("h2", {}, "New key"),
    h("div", { class: "grid" }, field("Name", name), field("Role", role),
      field("Scenes", scenes, h("span", { class: "quiet", id: "scenes-help" }, "Names or patterns: lab, floor-*")),
      field("Rate limit", rate), field("Share of the queue, %", share), field("Ends", ends, date)),
    h("p", { class: "buttons" }, h("button", { class: "primary" }, "Make key")));
  form.addEventListener("submit", event => {
    event.preventDefault();
    const named = scenes.value.split(",").map(text => text.trim()).filter(Boolean);
    make(name.value.trim(), {
      role: role.value,
      scenes: named.length && !scenes.disabled ? named : null,
      rate: rate.value.trim() || null,
      queue_share: share.value ? Number(share.value) / 100 : null,
      expires: expiry(ends.value, date.value),
    }).then(() => { form.reset(); settle(); }, told);
  });
  return form;
}

/** When a key ends, as the API has it; a date ends it as that day begins, in the visitor's time zone. */
function expiry(ends, date) {
  if (!ends) return null;
  return (ends === "date" ? new Date(`${date}T00:00`) : new Date(Date.now() + Number(ends) * DAY_MS)).toISOString();
}

function field(label, control, more = null) {
  return h("div", {}, h("label", { class: "field" }, label, control), more);
}

function select(pairs) {
  return h("select", {}, pairs.map(([value, text]) => h("option", { value }, text)));
}
