"use strict";
// The page: verdict, tables, settings, and the parts in their order.

/** A table of texts; the first column names the rows. */
function table(heads, rows, kind) {
  return el("table", { class: kind }, el("thead", {}, el("tr", {}, heads.map((head) => el("th", { scope: "col" }, head)))),
    el("tbody", {}, rows.map((row) => el("tr", {}, row.map((cell) => el("td", {}, cell))))));
}

const accuracyOf = (run) => (run.result.accuracy || {}).sorted;
const intervalsOf = (run) => ((run.result.intervals || {}).accuracy || {}).sorted;

/** mAP; where classes have no objects, the mean of the others. */
function meanOf(run, iou) {
  const accuracy = accuracyOf(run);
  if (!accuracy) return null;
  if (known(accuracy.mAP[iou])) return accuracy.mAP[iou];
  const values = Object.values(accuracy.AP).map((ap) => ap[iou]).filter(known);
  return values.length ? sum(values) / values.length : null;
}

/** Runs that have a card. */
const MOST_CARDS = 12;

/** The run of the ego alone that a run is compared with. */
const aloneOf = (run) => (known(run.against) ? DOC.runs[run.against] : null);

function verdict() {
  const names = DOC.runs.map((run) => run.name);
  byId("title").textContent = names.length > 4 ? `${names.slice(0, 3).join(", ")} and ${names.length - 3} more` : names.join(" · ");
  const [first] = DOC.runs;
  const shared = (pick) => { const all = [...new Set(DOC.runs.map(pick))]; return all.length === 1 ? all[0] : null; };
  const logs = shared((run) => run.result.logs.join(", "));
  const ended = DOC.runs.filter((run) => run.result.ended_by);
  const facts = [shared((run) => run.result.mode), shared((run) => run.result.link) && shared((run) => run.result.mode) !== "offline" && `link ${first.result.link}`,
    logs && (first.result.logs.length > 3 ? `${first.result.logs.length} logs` : `log ${logs}`), shared((run) => run.result.ego) && `ego ${first.result.ego}`,
    shared((run) => run.result.model) && `model ${first.result.model}`, shared((run) => run.result.protocol) && `protocol ${first.result.protocol}`,
    `${plural(first.result.frames.key, "scored sweep")}`,
    ended.length && (ended.length === DOC.runs.length ? `ended by ${[...new Set(ended.map((run) => run.result.ended_by))].join(", ")} before the log was` : `${plural(ended.length, "run")} ended before the log was`)];
  byId("what").textContent = facts.filter(Boolean).join(" · ");
  const score = (run) => meanOf(run, DOC.iou) ?? -1;
  const places = DOC.runs.map((_, at) => at);
  // A few stay as they were named, in the order of the table.
  const order = places.length > MOST_CARDS ? places.sort((a, b) => score(DOC.runs[b]) - score(DOC.runs[a])) : places;
  byId("scoreboard").replaceChildren(...order.slice(0, MOST_CARDS).map((at) => {
    const run = DOC.runs[at];
    const interval = intervalsOf(run) && intervalsOf(run).mAP[DOC.iou];
    const classes = accuracyOf(run) ? Object.entries(accuracyOf(run).AP).filter(([, ap]) => known(ap[DOC.iou])) : [];
    return el("div", { class: "score", style: `--c:${runColor(at)}` }, el("span", { class: "name" }, run.name), el("b", {}, fixed(meanOf(run, DOC.iou))),
      el("small", {}, `mAP at IoU ${DOC.iou}${interval ? `, 95 %: ${fixed(interval[0])}–${fixed(interval[1])}` : ""}`),
      el("small", {}, classes.map(([klass, ap]) => `${klass} ${fixed(ap[DOC.iou], 2)}`).join(" · ")),
      run.result.ended_by ? el("small", {}, `ended by ${run.result.ended_by}, after ${plural(run.result.frames.key, "scored sweep")}`) : null);
  }), DOC.runs.length > MOST_CARDS ? el("p", { class: "muted", style: "flex-basis:100%;margin:0" }, `The ${MOST_CARDS} best of ${DOC.runs.length} runs; the table has all.`) : "");
  byId("sentences").replaceChildren(...DOC.verdict.map((sentence) => el("li", {}, sentence)));
  if (DOC.left_out.length) {
    byId("omitted").hidden = false;
    byId("omitted").querySelector("summary").textContent = `Not on this page: ${plural(DOC.left_out.length, "thing")}`;
    byId("omitted").querySelector("ul").replaceChildren(...DOC.left_out.map((line) => el("li", {}, line)));
  }
}

/** The table of scores: rows by kind, a column for each run, the best of a row in bold. */
function scores() {
  const rows = [];
  const add = (name, pick, places = 3, better = 1, small = () => null, written = fixed) => {
    const values = DOC.runs.map(pick);
    if (!values.some(known) && !DOC.runs.some(small)) return;
    const numbers = values.filter(known);
    const best = DOC.runs.length > 1 && better && numbers.length > 1 ? better * Math.max(...numbers.map((value) => better * value)) : null;
    rows.push(el("tr", {}, el("td", {}, name), DOC.runs.map((run, at) => el("td", { class: known(best) && fixed(values[at], places) === fixed(best, places) ? "best" : null },
      places === 0 ? count(values[at]) : written(values[at], places), small(run) ? el("small", {}, small(run)) : null))));
  };
  const group = (name) => rows.push(el("tr", { class: "group" }, el("td", { colspan: DOC.runs.length + 1 }, name)));
  const bounds = (pair) => pair && `${fixed(pair[0])}–${fixed(pair[1])}`;
  // Each over the ego alone of its own logs, or none.
  const all = new Set(DOC.runs.map(aloneOf).filter(Boolean));
  const margin = (iou) => (run) => {
    const [own, alone] = [meanOf(run, iou), aloneOf(run) && meanOf(aloneOf(run), iou)];
    return known(own) && known(alone) ? own - alone : null;
  };
  const over = (run) => (run.no_margin ? `no run of the ego alone has the same ${run.no_margin}` : aloneOf(run) && all.size > 1 ? `over ${aloneOf(run).name}` : null);
  for (const iou of iousOf()) {
    group(`Average precision at IoU ${iou}`);
    add("mean over classes", (run) => meanOf(run, iou), 3, 1, (run) => bounds(intervalsOf(run) && intervalsOf(run).mAP[iou]));
    for (const klass of classesOf()) {
      add(klass, (run) => accuracyOf(run) && (accuracyOf(run).AP[klass] || {})[iou], 3, 1, (run) => bounds(intervalsOf(run) && (intervalsOf(run).AP[klass] || {})[iou]));
    }
    add("objects that the ego itself sees", (run) => run.result.accuracy_seen && run.result.accuracy_seen.sorted.mAP[iou]);
    add("margin over the ego alone", margin(iou), 3, all.size > 1 ? 0 : 1, over, signed);
  }
  group("Cost and time");
  const field = (name) => (run) => (run.fields[name] === "" || !known(run.fields[name]) ? null : Number(run.fields[name]));
  add("KB for each sweep of the ego", field("KB_per_frame"), 1, -1);
  add(DOC.runs.every((run) => run.result.mode === "offline") ? "stamps apart, median, ms" : "age of fused data, median, ms", field("age_ms"), 1, -1);
  add("from sweep to boxes, median, ms", field("end_to_end_ms"), 1, -1);
  group("Sweeps");
  add("scored", (run) => run.result.frames.key, 0, 0);
  add("scored, without boxes", (run) => run.result.frames.key_skipped, 0, 0);
  byId("table").replaceChildren(el("table", {}, el("thead", {}, el("tr", {}, el("th", {}, ""), DOC.runs.map((run, at) => el("th", { scope: "col" }, swatch(runColor(at)), run.name)))), el("tbody", {}, rows)),
    DOC.runs.every((run) => !run.alone) ? el("p", { class: "muted hint" }, "No run here is of the ego alone, so there is no margin: run the graph no_fusion over the same log, and give its folder too.") : "");
}

/** Objects of a table at first, and in all. */
const FEW = 8, MOST_ADDED = 200;

/** A table that opens with a click. */
const more = (heads, words, rows, open = false) => (words ? el("details", { open }, el("summary", {}, words), el("div", { class: "wide" }, table(heads, rows))) : null);

/** The run that objects are compared with; `null`: each run with the ego alone of its own logs. */
let comparedWith = null;
alsoKept.push({
  name: "beside",
  value: () => (known(comparedWith) ? String(comparedWith) : ""),
  take: (text) => { comparedWith = /^\d+$/.test(text) && DOC.runs[text] ? Number(text) : null; },
  again: addedObjects,
});

/** For each run of a scene the run beside it with which its objects are compared, `-1` where there is none. */
function besides(of) {
  const place = (run) => of.runs.findIndex((one) => one.run === run);
  const own = of.runs.map(({ run }) => (known(DOC.runs[run].against) ? place(DOC.runs[run].against) : -1));
  // Without the ego alone, runs that fuse are compared with the second of them, as the player shows it.
  const second = of.runs.length > 1 && own.every((one) => one < 0) ? 1 : -1;
  const other = known(comparedWith) && place(comparedWith) >= 0 ? place(comparedWith) : second;
  return other < 0 ? own : of.runs.map((_, at) => (at === other ? -1 : other));
}

/** What two runs of a scene found of each object, over all its sweeps. */
function tracksOf(of, run, beside) {
  const tracks = new Map();
  for (const seq of timeline()) {
    const [other, own] = [judged(of, beside, seq), judged(of, run, seq)];
    if (!other || !own || !other.known || !own.known) continue;
    const before = new Map(other.objects.map((object) => [object.track, object]));
    for (const object of own.objects) {
      const then = before.get(object.track);
      if (!object.counts || object.track < 0 || !then || !chosen(object)) continue;
      const track = tracks.get(object.track) || { track: object.track, klass: object.klass, sweeps: 0, other: 0, own: 0, points: [], seq: null, lost: null };
      track.sweeps += 1;
      track.other += then.foundBy ? 1 : 0;
      track.own += object.foundBy ? 1 : 0;
      if (object.points.length) track.points.push(object.points);
      if (object.foundBy && !then.foundBy && track.seq === null) track.seq = seq;
      if (!object.foundBy && then.foundBy && track.lost === null) track.lost = seq;
      tracks.set(object.track, track);
    }
  }
  return [...tracks.values()].map((track) => ({ ...track, gain: track.own - track.other }));
}

/** The median of an agent's points on an object. */
const pointsOfAgent = ({ points }, agent) => quantile(points.map((all) => all[agent] || 0), 0.5);

/** Which of the others has most points on an object, and how many. */
function bestOther(of, track) {
  if (!track.points.length) return NONE;
  const others = of.agents.map((agent, at) => [agent.name, pointsOfAgent(track, at)]).slice(1).sort((a, b) => b[1] - a[1]);
  return others.length && others[0][1] > 0 ? `${others[0][0]} ${count(others[0][1])}` : NONE;
}

/** The objects that a run finds in more sweeps, and in fewer, than another one. */
function addedBy(of, run, beside) {
  const [own, other] = [run, beside].map((at) => DOC.runs[of.runs[at].run]);
  const than = other.alone ? "the ego alone" : other.name;
  const all = tracksOf(of, run, beside);
  const rows = (list, at) => list.map((one) => [
    el("button", { type: "button", title: "Show it in the player", onclick: () => show(at(one), { kind: "object", run, seq: at(one), index: 0, track: one.track }) }, `${one.klass} ${trackName(of, one.track)}`),
    count(one.sweeps), count(one.other), count(one.own), one.points.length ? count(pointsOfAgent(one, 0)) : NONE, bestOther(of, one)]);
  const gained = all.filter((one) => one.gain > 0 && one.seq !== null).sort((a, b) => b.gain - a.gain);
  const harmed = all.filter((one) => one.gain < 0 && one.lost !== null).sort((a, b) => a.gain - b.gain);
  const heads = ["object", "sweeps", `found by ${than}`, `found by ${own.name}`, "own points, median", "most points of others, median"];
  return el("div", { style: "margin-bottom:16px" },
    el("h3", {}, swatch(runColor(of.runs[run].run)), own.name),
    el("p", { class: "muted" }, `${plural(gained.length, "object")} found in more sweeps than by ${than}, ${plural(harmed.length, "object")} in fewer.`),
    gained.length ? el("div", { class: "wide" }, table(heads, rows(gained.slice(0, FEW), (one) => one.seq))) : null,
    more(heads, gained.length > FEW && `${plural(gained.length - FEW, "object")} more`, rows(gained.slice(FEW, MOST_ADDED), (one) => one.seq)),
    more(heads, harmed.length && `${plural(harmed.length, "object")} found in fewer sweeps`, rows(harmed.slice(0, MOST_ADDED), (one) => one.lost), !gained.length || !other.alone));
}

/** Objects that a run finds in more sweeps than the ego alone, or another run, in the scene of the player. */
function addedObjects() {
  const section = byId("added");
  const of = DOC.scenes.length ? scene() : null;
  const beside = of ? besides(of) : [];
  const compared = beside.map((_, at) => at).filter((at) => beside[at] >= 0);
  section.hidden = !compared.length;
  if (section.hidden) return;
  const withAlone = compared.every((at) => DOC.runs[of.runs[beside[at]].run].alone);
  const anyAlone = of.runs.some(({ run }) => known(DOC.runs[run].against));
  const options = [...(anyAlone ? [[null, "the ego alone"]] : []), ...of.runs.filter(({ run }) => !DOC.runs[run].alone).map(({ run }) => [run, DOC.runs[run].name])];
  const now = anyAlone && withAlone ? null : of.runs[beside[compared[0]]].run;
  const limits = `${compared.length > 3 ? ` The first 3 of ${compared.length} runs that are compared.` : ""} A table has ${MOST_ADDED} objects at most.`;
  section.replaceChildren(el("h2", {}, withAlone ? "What cooperation added" : `What differs from ${DOC.runs[now].name}`),
    options.length > 1 ? el("div", { class: "tools" }, choice("Compared with", options, now, (run) => { comparedWith = run; addedObjects(); navigation(); keepPlace(); })) : "",
    el("p", { class: "muted" }, `${sweepsInWords(of)} of ${of.log}, ego ${of.ego}, at IoU ${of.ious[state.iou]}${scoreWords()}, object by object${filterWords()}; a click on one shows it.${limits}`),
    ...compared.slice(0, 3).map((run) => addedBy(of, run, beside[run])));
}

// --- What was run -------------------------------------------------------------------------------------------------

const SETTINGS = ["program", "machine", "graph", "graph_hash", "mode", "coop", "link", "compute", "seed", "project", "pose_source", "precomputed", "model", "detections", "isa", "set", "programs", "rate", "protocol", "ended_by"];

function settings() {
  const special = { program: (run) => run.program, machine: (run) => run.timing.machine, detections: (run) => (run.recorded ? "recorded" : "") };
  const value = (run, name) => String((special[name] ? special[name](run) : run.result[name]) ?? "");
  const rows = SETTINGS.filter((name) => DOC.runs.some((run) => value(run, name))).map((name) => [name.replace("_", " "), ...DOC.runs.map((run) => value(run, name) || NONE)]);
  rows.push(["logs", ...DOC.runs.map((run) => (run.result.logs.length > 5 ? `${run.result.logs.length} logs` : run.result.logs.join(", ") || NONE))],
    ["egos", ...DOC.runs.map((run) => run.result.egos.join(", ") || NONE)], ["agents", ...DOC.runs.map((run) => run.result.agents.join(", ") || NONE)]);
  const same = rows.filter((row) => row.length > 2 && new Set(row.slice(1)).size === 1);
  const differ = rows.filter((row) => !same.includes(row));
  byId("settings").replaceChildren(
    DOC.differences.length ? el("ul", {}, DOC.differences.map((line) => el("li", {}, line))) : "",
    table(["setting", ...DOC.runs.map((run) => run.name)], differ, "text"),
    same.length ? el("p", { class: "muted", style: "margin-top:10px" }, "The same in all: " + same.map((row) => `${row[0]} ${row[1]}`).join("; ") + ".") : "",
  );
  const notes = DOC.runs.filter((run) => run.result.notes.length);
  byId("notes").replaceChildren(...notes.map((run) => el("div", {}, el("h3", {}, `Notes of ${run.name}`), el("ul", {}, run.result.notes.map((note) => el("li", {}, note))))));
  byId("graphs").replaceChildren(...DOC.runs.slice(0, 12).filter((run) => Object.keys(run.graph).length).map((run) =>
    el("details", { class: "graph" }, el("summary", {}, `Graph of ${run.name}: ${plural(Object.keys(run.graph).length, "stage")}`), el("div", { class: "wide" }, graph(run)))));
  byId("foot").textContent = `Made by ${DOC.program}. Words are explained in docs/glossary.md and docs/reference/results.md of realo.`;
}

/** A run's graph with what was measured of it, and the settings of its stages, as the graph has them before options of the run. */
function graph(run) {
  const settings = Object.entries(run.graph).map(([stage, has]) => [stage, has.runs || NONE,
    Object.entries(has).filter(([key]) => key.startsWith("settings.")).map(([key, value]) => `${key.slice(9)}=${value}`).join(" ") || NONE]);
  const picture = run.picture ? el("button", { class: "picture", type: "button", "aria-label": "Larger or smaller", onclick: (event) => event.currentTarget.classList.toggle("large") },
    el("img", { src: "data:image/svg+xml;charset=utf-8," + encodeURIComponent(run.picture), alt: `Graph of ${run.name}` })) : "";
  const hint = el("p", { class: "muted hint" }, "Settings are those of the graph. What options of the run changed stands in the table of settings above.");
  return el("div", {}, picture, hint, table(["stage", "runs", "settings of the graph"], settings, "text"));
}

const ofCharts = (name, otherwise, known) => ({
  name: "charts-" + name,
  value: () => (asked[name] === otherwise ? "" : asked[name]),
  take: (text) => { asked[name] = known().includes(text) ? text : otherwise; },
  again: charts,
});
alsoKept.push(ofCharts("klass", "", classesOf), ofCharts("iou", DOC.iou, iousOf));

function charts() {
  const again = (change) => (value) => { change(value); drawCharts(); drawFlows(); keepPlace(); };
  byId("choices").replaceChildren(
    choice("Class", [["", "all"], ...classesOf().map((klass) => [klass, klass])], asked.klass, again((klass) => { asked.klass = klass; })),
    choice("IoU", iousOf().map((iou) => [iou, iou]), asked.iou, again((iou) => { asked.iou = iou; })));
  byId("key").replaceChildren(...DOC.runs.map((run, at) => el("span", {}, svg("svg", { width: 26, height: 10, "aria-hidden": "true" },
    svg("path", { d: "M1 5H25", stroke: runColor(at), "stroke-width": 2.4, "stroke-dasharray": runDash(at) })), run.name)));
  drawCharts();
  drawFlows();
}

function navigation() {
  const parts = [["player", "Player"], ["added", "Objects"], ["scores", "Scores"], ["charts", "Where and when"], ["messages", "Messages"], ["setup", "Settings"]];
  byId("nav").replaceChildren(...parts.filter(([id]) => !byId(id).hidden).map(([id, name]) =>
    el("a", { href: "#" + id, onclick: (event) => { event.preventDefault(); byId(id).scrollIntoView(); } }, name)));
  document.querySelector(".brand").addEventListener("click", (event) => { event.preventDefault(); scrollTo(0, 0); });
}

function theme() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let chosen = false;
  setTheme(dark.matches ? "dark" : "light");
  dark.addEventListener("change", () => { if (!chosen) setTheme(dark.matches ? "dark" : "light"); });
  byId("theme").addEventListener("click", () => {
    chosen = true;
    setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  });
}

theme();
verdict();
scores();
startPlayer();
addedObjects();
charts();
settings();
navigation();
repainted.push(drawMaps);
filtersChanged = addedObjects;
sceneOpened = () => { addedObjects(); drawCharts(); drawFlows(); navigation(); };
addEventListener("resize", drawMaps);
