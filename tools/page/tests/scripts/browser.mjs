// What the page's scripts ask of a browser, as far as their tests need it: elements without layout, a clock that stands still
// until a test moves it, and a canvas that notes what is drawn on it.

import { readFileSync } from "node:fs";
import vm from "node:vm";

const PAGE = new URL("../../src/page/", import.meta.url);
const read = (name) => readFileSync(new URL(name, PAGE), "utf8");

class Node {
  constructor(tag) {
    Object.assign(this, { tag, attributes: {}, nodes: [], listeners: {}, style: { cssText: "", setProperty() {} }, dataset: {}, hidden: false, value: "" });
  }
  append(...nodes) { this.nodes.push(...nodes.map((node) => (node instanceof Node ? node : String(node)))); }
  replaceChildren(...nodes) { this.nodes = []; this.append(...nodes); }
  remove() { this.isGone = true; }
  setAttribute(name, value) {
    this.attributes[name] = String(value);
    if (["value", "min", "max"].includes(name)) this[name] = String(value);
    if (name === "checked") this.checked = true;
  }
  getAttribute(name) { return this.attributes[name] ?? null; }
  addEventListener(name, hears) { (this.listeners[name] ||= []).push(hears); }
  dispatch(name, event = {}) { (this.listeners[name] || []).forEach((hears) => hears({ type: name, target: this, preventDefault() {}, ...event })); }
  get textContent() { return this.nodes.map((node) => (node instanceof Node ? node.textContent : node)).join(""); }
  set textContent(text) { this.nodes = [String(text)]; }
  get selectedIndex() { return Math.max(0, this.all("option").findIndex((option) => "selected" in option.attributes)); }
  contains(node) { return this === node || this.nodes.some((one) => one instanceof Node && one.contains(node)); }
  /** All elements of a tag within. */
  all(tag) { return this.nodes.filter((node) => node instanceof Node).flatMap((node) => [...(node.tag === tag ? [node] : []), ...node.all(tag)]); }
  querySelector(tag) { return this.all(tag)[0] || null; }
  getBoundingClientRect() { return { left: 0, top: 0, width: 800, height: 400 }; }
  scrollIntoView() {}
  focus() { Node.focused = this; }
  setPointerCapture() {}
  getContext() { return (this.context ||= canvasContext()); }
}

/** A context whose `calls` are what was asked of it: `[name, ...arguments]`. */
function canvasContext() {
  const calls = [];
  const own = {
    calls,
    createImageData: (width, height) => ({ width, height, data: new Uint8ClampedArray(4 * width * height) }),
  };
  return new Proxy(own, { get: (target, name) => (name in target ? target[name] : (...given) => { calls.push([name, ...given]); }) });
}

/** The elements of index.html that have a name. */
function elements() {
  const named = new Map();
  for (const [whole, tag, id] of read("index.html").matchAll(/<(\w+)[^>]*? id="(\w+)"[^>]*>/g)) named.set(id, Object.assign(new Node(tag), { hidden: / hidden>/.test(whole) }));
  for (const tag of ["summary", "ul"]) named.get("omitted").append(new Node(tag));
  return named;
}

/**
 * A page with this document, address and points. Its `value` gives that of an expression of the page's scripts, `wait` lets time go
 * by in one step, `play` in pictures of 20 ms.
 */
export function open({ scripts = ["tools.js", "player.js", "charts.js", "report.js"], data, points = "", hash = "" }) {
  const named = elements();
  named.get("data").textContent = JSON.stringify(data);
  named.get("points").textContent = points;
  const page = { now: 0, timers: [], pictures: [], sockets: [], listeners: {}, addresses: [] };
  const timer = (does, wait, again) => { page.timers.push({ does, at: page.now + (wait || 0), again, id: ++page.lastTimer }); return page.lastTimer; };
  page.lastTimer = 0;
  const root = new Node("html");
  const document = {
    documentElement: root, get activeElement() { return Node.focused ?? null; }, title: "",
    getElementById: (id) => (named.has(id) && !named.get(id).isGone ? named.get(id) : null),
    createElement: (tag) => new Node(tag),
    createElementNS: (_, tag) => new Node(tag),
    querySelector: () => new Node("a"),
    querySelectorAll: () => ["verdict", "player", "added", "scores", "charts", "messages", "setup"].map((id) => Object.assign(named.get(id), { id })),
  };
  const globals = {
    document, URLSearchParams, TextDecoder, atob, console,
    performance: { now: () => page.now },
    location: { hash, host: "127.0.0.1:8800" },
    history: { replaceState: (_, __, address) => { page.addresses.push(address); } },
    devicePixelRatio: 1,
    matchMedia: () => ({ matches: false, addEventListener() {} }),
    getComputedStyle: () => ({ getPropertyValue: () => "#102030" }),
    ResizeObserver: class { observe() {} },
    WebSocket: class { constructor(url) { Object.assign(this, { url, hears: {} }); page.sockets.push(this); } addEventListener(name, hears) { this.hears[name] = hears; } },
    setTimeout: (does, wait) => timer(does, wait),
    setInterval: (does, wait) => timer(does, wait, wait),
    clearTimeout: (id) => { page.timers = page.timers.filter((one) => one.id !== id); },
    requestAnimationFrame: (draws) => { page.pictures.push(draws); },
    addEventListener: (name, hears) => { (page.listeners[name] ||= []).push(hears); },
    scrollTo() {},
  };
  globals.window = globals;
  const context = vm.createContext(globals);
  vm.runInContext(scripts.map(read).join("\n"), context, { filename: "page.js" });
  page.value = (expression) => vm.runInContext(`(${expression})`, context);
  page.byId = (id) => named.get(id);
  page.wait = (time) => {
    page.now += time;
    for (const due of page.timers.filter((one) => one.at <= page.now)) {
      if (due.again) due.at = page.now + due.again;
      else page.timers.splice(page.timers.indexOf(due), 1);
      due.does();
    }
  };
  page.play = (time) => {
    for (const end = page.now + time; page.now < end;) {
      page.wait(20);
      page.pictures.splice(0).forEach((draws) => draws(page.now));
    }
  };
  page.press = (key, more = {}) => page.listeners.keydown.forEach((hears) => hears({ key, target: root, preventDefault() {}, ...more, target: { tagName: "BODY", ...more.target } }));
  page.goTo = (to) => { globals.location.hash = to; page.listeners.hashchange.forEach((hears) => hears({})); };
  return page;
}
