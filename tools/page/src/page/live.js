"use strict";
// The page of a run that goes on: pictures come from the server that the page is from, and the newest is shown.

/** Sweeps that the page keeps, and those of them with points. */
const KEPT = 600, KEPT_CLOUDS = 150;
/** Numbers of tracks that the page keeps; each picture brings its own. */
const KEPT_TRACKS = 20000;
/** Between two tries to reach the server, ms. */
const AGAIN = 1000;
/** Between two drawings of what changes slowly, ms. */
const SLOWLY = 1000;

/** What is known of the run; a test reads how many pictures came. */
const live = { shows: true, reached: false, run: null, ended: false, pictures: 0, points: 0, times: [], slow: -SLOWLY, fitted: null, classes: 0, used: new Map() };

function say(words) {
  byId("what").textContent = words;
}

/** Words about the run: pictures a second, and whether the newest is shown. */
function sayHow() {
  if (!live.reached) { say("The run has ended and its view is closed, or cannot be reached. What came until then stays here."); return; }
  if (!live.run) { say("Waiting for the first run to begin."); return; }
  if (live.ended) { say(`${live.run.mode} · the run has ended. Its table is in the terminal, and realo report makes a page of it.`); return; }
  const since = performance.now() - 3000;
  live.times = live.times.filter((time) => time > since);
  const rate = (live.times.length / 3).toFixed(1);
  const count = live.times.length ? `${rate} pictures a second` : live.pictures ? "no new picture comes" : "waiting for the first boxes";
  say([live.run.mode, count, live.shows ? null : "an earlier sweep is shown: Live goes to the newest"].filter(Boolean).join(" · "));
}

function setShows(newest) {
  live.shows = newest;
  if (live.button) live.button.setAttribute("aria-pressed", String(newest));
  if (newest && panes.length && timeline().length) {
    state.playing = false;
    transport.play.textContent = "▶";
    seek(timeline().length - 1);
  }
  sayHow();
}

/** A new run takes the place of the one before. */
function openRun({ run, scene: opened, iou, classes }) {
  live.run = run;
  live.ended = false;
  live.pictures = 0;
  live.times = [];
  live.fitted = null;
  live.used.clear();
  DOC.iou = iou;
  DOC.classes = classes;
  DOC.runs = [{ name: run.name, alone: run.alone }];
  DOC.scenes = [opened];
  DOC.points = [];
  for (const kept of [timelines, judgedSweeps, extents, clouds, decoded]) kept.clear();
  panes.length = 0;
  byId("panes").replaceChildren();
  byId("player").hidden = true;
  Object.assign(state, { scene: 0, at: 0, runs: [0], iou: Math.max(0, opened.ious.indexOf(iou)), picked: null, agent: -1, playing: false });
  byId("title").textContent = run.name;
  document.title = `${run.name} · realo view`;
  live.shows = true;
  sayHow();
}

/** What belongs to a sweep is computed anew. */
function forget(seq) {
  for (let iou = 0; iou < scene().ious.length; iou++) judgedSweeps.delete(`0.0.${seq}.${iou}`);
}

function dropOld() {
  const of = scene(), seqs = timeline();
  while (seqs.length > KEPT) {
    const seq = seqs.shift();
    delete of.frames[seq];
    delete of.runs[0].frames[seq];
    forget(seq);
    if (state.at > 0) state.at -= 1;
  }
  if (seqs.length > KEPT_CLOUDS) {
    const oldest = of.frames[seqs[seqs.length - KEPT_CLOUDS]].t - 200;
    const old = DOC.points.filter((part) => part.t < oldest);
    if (old.length > 64) {
      old.forEach((part) => decoded.delete(part));
      DOC.points = DOC.points.filter((part) => part.t >= oldest);
      clouds.clear();
    }
  }
}

function takePicture(buffer) {
  if (!live.run) return;
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const of = scene(), { seq } = head;
  const seqs = timeline();
  if (seqs.length && of.frames[seqs.at(-1)].t > head.frame.t) return;
  of.frames[seq] = head.frame;
  of.runs[0].frames[seq] = head.run;
  addUsed(seq, live.used.get(seq) || []);
  live.used.delete(seq);
  of.agents = head.agents;
  of.tracks = Object.keys(of.tracks || {}).length > KEPT_TRACKS ? { ...head.tracks } : Object.assign(of.tracks || {}, head.tracks);
  DOC.classes = head.classes;
  seqs.push(seq);
  for (const { agent, t, from, points } of head.clouds) {
    const part = { log: of.log, agent, t, from, steps: new DataView(buffer, 4 + length + 2 * points[0], 2 * points[1]) };
    if (cloudsOf(of.log, agent).some((known) => known.t === t)) continue;
    cloudsOf(of.log, agent).push(part);
    DOC.points.push(part);
    live.points += points[1] / 3;
  }
  live.pictures += 1;
  live.times.push(performance.now());
  dropOld();
  if (!panes.length) open();
  if (live.shows) state.at = seqs.length - 1;
  if (!state.playing) draw();
  slowly();
}

function open() {
  byId("player").hidden = false;
  setUp();
  fit();
}

/** Looks at all of the scene, as long as nobody has looked elsewhere. */
function fit() {
  extents.clear();
  fitView();
  live.fitted = JSON.stringify([camera, state.follow]);
}

function slowly() {
  const now = performance.now();
  if (now - live.slow < SLOWLY) return;
  live.slow = now;
  sayHow();
  drawStrip();
  if (live.pictures < 40 && live.fitted === JSON.stringify([camera, state.follow])) { fit(); draw(); }
  const known = scene().agents.length + Object.values(scene().runs[0].frames).reduce((all, frame) => Math.max(all, ((frame || {}).boxes || []).length ? 1 : 0), 0);
  if (known !== live.classes && !byId("filters").contains(document.activeElement)) { live.classes = known; makeFilters(); }
}

/** Adds what was fused for a sweep, each message once. It may be said before the sweep's picture comes. */
function addUsed(seq, rows) {
  const frame = scene().runs[0].frames[seq];
  if (!frame) {
    live.used.set(seq, (live.used.get(seq) || []).concat(rows));
    if (live.used.size > KEPT) live.used.delete(live.used.keys().next().value);
    return;
  }
  const known = new Set((frame.used || []).map(String));
  frame.used = (frame.used || []).concat(rows.filter((row) => !known.has(String(row)) && known.add(String(row))));
  forget(seq);
}

function takeText(text) {
  const said = JSON.parse(text);
  if (said.what === "scene") openRun(said);
  if (said.what === "ended") { live.ended = true; sayHow(); }
  if (said.what === "used" && live.run) {
    scene().agents = said.agents;
    for (const [seq, rows] of Object.entries(said.used)) addUsed(Number(seq), rows);
    if (panes.length && !state.playing) draw();
  }
}

function connect() {
  const socket = new WebSocket(`ws://${location.host}/pictures`);
  socket.binaryType = "arraybuffer";
  socket.addEventListener("open", () => { live.reached = true; sayHow(); });
  socket.addEventListener("message", ({ data }) => (typeof data === "string" ? takeText(data) : takePicture(data)));
  socket.addEventListener("close", () => {
    live.reached = false;
    sayHow();
    setTimeout(connect, AGAIN);
  });
}

function startLive() {
  for (const section of document.querySelectorAll("main > section")) section.hidden = !["verdict", "player"].includes(section.id);
  byId("player").hidden = true;
  byId("title").textContent = "realo";
  for (const id of ["scoreboard", "sentences", "omitted"]) byId(id).remove();
  byId("foot").textContent = `Made by ${DOC.program}. Words are explained in docs/glossary.md of realo.`;
  live.button = el("button", { type: "button", id: "live", "aria-pressed": "true", onclick: () => setShows(!live.shows) }, "Live");
  byId("nav").replaceChildren(live.button);
  // Whoever plays or goes elsewhere stays there, until playing comes to the newest.
  placeChosen = (plays) => {
    if (!plays && state.playing && state.at === timeline().length - 1) setShows(true);
    else if (live.shows) { live.shows = false; live.button.setAttribute("aria-pressed", "false"); sayHow(); }
  };
  const dark = matchMedia("(prefers-color-scheme: dark)");
  setTheme(dark.matches ? "dark" : "light");
  byId("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
  repainted.push(() => { draw(); if (panes.length) makeLegend(); });
  addEventListener("keydown", (event) => {
    if (!panes.length) return;
    if (event.key === "End") setShows(true);
    else onKey(event);
  });
  new ResizeObserver(() => { resize(); draw(); }).observe(byId("panes"));
  setInterval(sayHow, SLOWLY);
  connect();
}

startLive();
