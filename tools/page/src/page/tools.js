"use strict";
// What the parts of the page share: the document, elements, numbers, colours.

const DOC = JSON.parse(document.getElementById("data").textContent);
const KINDS = DOC.words.kinds;
const FATES = DOC.words.fates;
const FATE_WORDS = {
  used: "used", skipped: "skipped by a busy stage", over_limit: "over the limit", distrusted: "distrusted",
  stale: "too old", superseded: "replaced by a newer one", lost: "lost on the link", rejected: "rejected",
  in_flight: "in flight at the end",
};
const DASHES = ["", "7 3", "2 3", "9 3 2 3", "4 2", "12 4"];

/** An element. Children that are text stay text, whatever they hold. */
function el(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** An element of SVG. */
function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(node, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "style") node.style.cssText = value;
    else node.setAttribute(key, value === true ? "" : value);
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

const byId = (id) => document.getElementById(id);
const NONE = "–";
const known = (value) => value !== null && value !== undefined;
const fixed = (value, places = 3) => (known(value) ? value.toFixed(places) : NONE);
/** The sign of a number as it is written: that of nothing is none. */
const sign = (text, plus = "") => (Number(text) < 0 ? "−" : Number(text) > 0 ? plus : "") + text.replace("-", "");
const signed = (value, places = 3) => (known(value) ? sign(value.toFixed(places), "+") : NONE);
const count = (value) => (known(value) ? String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, ",") : NONE);
const ms = (value) => (known(value) ? sign(Math.abs(value) < 9.95 && value !== 0 ? value.toFixed(1) : String(Math.round(value))) + " ms" : NONE);
const sum = (values) => values.reduce((all, value) => all + value, 0);
const plural = (n, one, many = one + "s") => `${count(n)} ${n === 1 ? one : many}`;
const sorted = (values) => [...values].sort((a, b) => a - b);

/** The value that a share of all do not exceed. */
function quantile(values, share) {
  const all = sorted(values);
  return all.length ? all[Math.min(all.length - 1, Math.max(0, Math.ceil(share * all.length) - 1))] : null;
}

const runColor = (run) => `var(--run${run % 6})`;
const runDash = (run) => DASHES[(run + Math.floor(run / 6)) % DASHES.length];
const swatch = (color) => el("i", { class: "swatch", style: `--c:${color}` });

/** Colours of the style sheet as canvases need them. */
let paint = {};
function readPaint() {
  const style = getComputedStyle(document.documentElement);
  const names = ["view", "ink", "muted", "line", "grid", "wrong", "added", "added-fill", "hit", "truth", "accent", "card"];
  paint = { agents: [], runs: [] };
  for (const name of names) paint[name] = style.getPropertyValue("--" + name).trim();
  for (let at = 0; at < 6; at++) {
    paint.agents.push(style.getPropertyValue("--agent" + at).trim());
    paint.runs.push(style.getPropertyValue("--run" + at).trim());
  }
}
const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));

/** What redraws itself when colours change. */
const repainted = [];
function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  readPaint();
  repainted.forEach((draw) => draw());
}

/** Buttons of which one is pressed. */
function segments(options, chosen, choose) {
  const buttons = options.map(([value, label]) =>
    el("button", { type: "button", "aria-pressed": String(value === chosen), onclick: () => press(value) }, label));
  function press(value) {
    options.forEach(([of], at) => buttons[at].setAttribute("aria-pressed", String(of === value)));
    choose(value);
  }
  return el("span", { class: "seg" }, buttons);
}

/** A list of which one is chosen. */
function choice(label, options, chosen, choose) {
  const select = el("select", { onchange: () => choose(options[select.selectedIndex][0]) },
    options.map(([value, text]) => el("option", { selected: value === chosen }, text)));
  return el("label", {}, label, select);
}
