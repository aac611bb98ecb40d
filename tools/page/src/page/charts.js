"use strict";
// Charts: small drawings of shapes. Every series has a colour and a dash, so that none differs in hue alone.

const FRAME = { width: 380, height: 226, left: 44, right: 12, top: 22, bottom: 34 };

/** Round numbers between two ends. */
function ticks(low, high, about = 5) {
  const rough = (high - low) / about || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough);
  const all = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + step * 1e-6; value += step) all.push(Number(value.toFixed(10)));
  return all;
}

const tickText = (value) => (Math.abs(value) >= 10000 ? `${value / 1000}k` : String(value));

/** A drawing with a title, what it shows, and a frame. Without any value it says why there is none. */
function figure(title, what, content, none, span) {
  const label = content && content.getAttribute("aria-label");
  if (label) content.setAttribute("aria-label", `${title}: ${label.trim()}`);
  return el("figure", { class: span ? "span" : null }, el("figcaption", {}, title, el("small", {}, what)),
    content || el("div", { class: "none" }, none));
}

/**
 * Lines, steps or dots over two axes.
 * `series`: `{ name, color, dash, points: [[x, y] …], dots }`; `x`, `y`: `{ label, low, high, names, from }`, the last a value
 * that is always on the axis.
 */
function lines(series, x, y) {
  const drawn = series.filter((one) => one.points.length);
  if (!drawn.length) return null;
  const { width, height, left, right, top, bottom } = FRAME;
  const all = (axis) => drawn.flatMap((one) => one.points.map((point) => point[axis]));
  const ends = (axis, wanted) => {
    const values = all(axis);
    const low = wanted.low ?? values.reduce((a, b) => Math.min(a, b), wanted.from ?? Infinity);
    const high = wanted.high ?? values.reduce((a, b) => Math.max(a, b), -Infinity);
    return [low, high > low ? high : low + 1];
  };
  const [[x0, x1], [y0, y1]] = [ends(0, x), ends(1, y)];
  const px = (value) => left + (width - left - right) * (value - x0) / (x1 - x0);
  const py = (value) => height - bottom - (height - top - bottom) * (value - y0) / (y1 - y0);
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${y.label} over ${x.label}` });
  for (const value of ticks(y0, y1)) {
    picture.append(svg("line", { x1: left, x2: width - right, y1: py(value), y2: py(value), class: "axis" }),
      svg("text", { x: left - 6, y: py(value) + 4, "text-anchor": "end" }, tickText(value)));
  }
  const marks = x.names ? x.names.map((name, at) => [at, name]) : ticks(x0, x1).map((value) => [value, tickText(value)]);
  for (const [value, text] of marks) {
    picture.append(svg("text", { x: px(value), y: height - bottom + 16, "text-anchor": "middle" }, text));
  }
  picture.append(svg("text", { x: (left + width - right) / 2, y: height - 3, "text-anchor": "middle" }, x.label));
  picture.append(svg("text", { x: 2, y: 11 }, y.label));
  for (const one of drawn) {
    const path = one.points.map(([a, b]) => `${px(a).toFixed(1)} ${py(b).toFixed(1)}`);
    picture.append(svg("path", { d: "M" + path.join("L"), fill: "none", stroke: one.color, "stroke-width": 1.9, "stroke-dasharray": one.dash, "stroke-linejoin": "round" }));
    if (one.dots) {
      one.points.forEach(([a, b, words]) => picture.append(svg("circle", { cx: px(a), cy: py(b), r: 3.2, fill: one.color }, svg("title", {}, `${one.name}: ${words || b}`))));
    }
  }
  return picture;
}

/** A fill for one of many things: six hues, then the same with stripes in four directions. */
function fill(at, share = 100) {
  const hue = `var(--agent${at % 6})`;
  const color = share === 100 ? hue : `color-mix(in srgb, ${hue} ${share}%, var(--card))`;
  const turn = [null, 45, 135, 0, 90][Math.floor(at / 6) % 5];
  return turn === null ? color : `repeating-linear-gradient(${turn}deg, ${color} 0 5px, var(--card) 5px 8px)`;
}

/** Parts of a bar that are written out below it, at most. */
const MOST_WORDS = 5;

/**
 * Bars that are made of parts, one for each row: `{ name, parts: [[what, value, color, mark] …] }`; a mark stands on its part.
 * A few parts are written out, so that nobody has to point at them.
 */
function stacks(rows, unit, share) {
  const drawn = rows.filter((row) => row.parts.some(([, value]) => value > 0));
  if (!drawn.length) return null;
  const totals = drawn.map((row) => sum(row.parts.map(([, value]) => value)));
  const most = Math.max(...totals);
  const number = (value) => (value < 100 && value % 1 ? value.toFixed(1) : count(value));
  const percent = (value, of) => (share ? ` (${(100 * value / of).toFixed(1)} %)` : "");
  const inWords = (parts, of) => parts.map(([what, value]) => `${what} ${number(value)}${percent(value, of)}`).join(" · ");
  return el("div", { class: "stacks" }, drawn.map((row, at) => [row, row.parts.filter(([, value]) => value > 0), totals[at]]).map(([row, parts, total]) => [
    el("div", { class: "row" }, el("b", {}, row.name), el("span", {}, `${number(total)} ${unit}`)),
    el("div", { class: "track" }, parts.map(([what, value, color, mark]) => {
      const words = `${what}: ${number(value)} ${unit}`;
      return el("i", { title: words, "aria-label": words, role: "img", style: `width:${100 * value / (share ? total : most)}%;background:${color}` }, mark ? el("b", {}, mark) : null);
    })),
    parts.length > 1 && parts.length <= MOST_WORDS ? el("small", { class: "muted" }, inWords(parts, total)) : null,
  ]));
}

const partsKey = (names) => el("div", { class: "legend" }, names.map(([name, color]) => el("span", {}, swatch(color), name)));

const seriesOf = (run, points, more = {}) => ({ name: DOC.runs[run].name, color: runColor(run), dash: runDash(run), points, ...more });

/** What the charts are about. */
const asked = { klass: "", iou: DOC.iou };

/** Classes with objects, in the order of the player's. */
const classesOf = () => [...new Set(DOC.runs.flatMap((run) => Object.keys(run.curves)))].sort((a, b) => DOC.classes.indexOf(a) - DOC.classes.indexOf(b));
const iousOf = () => [...new Set(DOC.runs.flatMap((run) => Object.keys((run.result.accuracy || { sorted: { mAP: {} } }).sorted.mAP)))];

/** Bins of a table by class and IoU, of one class or the sum of all. */
function binsOf(table) {
  if (!table) return [];
  const chosen = Object.entries(table).filter(([klass]) => !asked.klass || klass === asked.klass);
  const rows = chosen.map(([, ious]) => ious[asked.iou]).filter(Boolean);
  return (rows[0] || []).map((bin, at) => ({
    from: bin.from, to: bin.to,
    true: sum(rows.map((row) => row[at].true)), false: sum(rows.map((row) => row[at].false || 0)), total: sum(rows.map((row) => row[at].total)),
  }));
}

const binName = (bin) => (known(bin.to) ? `${bin.from}–${bin.to}` : `≥ ${bin.from}`);

function binChart(title, what, table, value, words, label) {
  const names = (binsOf(DOC.runs.map((run) => run.result[table]).find(Boolean))).map(binName);
  const series = DOC.runs.map((run, at) => seriesOf(at, binsOf(run.result[table])
    .map((bin, place) => [place, value(bin), words(bin)]).filter((point) => Number.isFinite(point[1])), { dots: true }));
  return figure(title, what, names.length ? lines(series, { label, low: -0.2, high: names.length - 0.8, names }, { label: "", low: 0, high: 1 }) : null,
    "These results have no such bins.");
}

function drawCharts() {
  const charts = [];
  const wanted = asked.klass ? [asked.klass] : classesOf();
  for (const klass of wanted) {
    const series = DOC.runs.map((run, at) => seriesOf(at, ((run.curves[klass] || {})[asked.iou] || []).map(([recall, precision]) => [recall, precision])));
    charts.push(figure(`Precision and recall: ${klass}`, apWords(klass), lines(series, { label: "recall", low: 0, high: 1 }, { label: "precision", low: 0, high: 1 }), "No run has scored objects of this class."));
  }
  const of = asked.klass || "all classes";
  const found = (bin) => bin.true / bin.total;
  charts.push(
    binChart("Recall by distance", `${of}; found share of the objects, of all scores`, "precision_recall_by_range", found, (bin) => `${bin.true} of ${bin.total}`, "m from the ego"),
    binChart("Precision by distance", `${of}; true share of the detections of all scores`, "precision_recall_by_range", (bin) => bin.true / (bin.true + bin.false), (bin) => `${bin.true} of ${bin.true + bin.false}`, "m from the ego"),
    binChart("Recall by own points", `${of}; few points: far or hidden from the ego. How much of an object is occluded is not in logs and results`, "recall_by_points", found, (bin) => `${bin.true} of ${bin.total}`, "points of the ego on the object"),
    ageChart(of), countsChart(of), missedChart(of), offsetChart(of), hitMaps(),
  );
  byId("grid").replaceChildren(...charts);
  drawMaps();
}

function apWords(klass) {
  const ap = DOC.runs.slice(0, 4).map((run) => {
    const table = run.result.accuracy && run.result.accuracy.sorted.AP[klass];
    return `${run.name} ${fixed(table && table[asked.iou])}`;
  });
  return `AP at IoU ${asked.iou}: ${ap.join(", ")}`;
}

/** Sweeps of the player's scene, judged, of a run of the page. */
function sweepsOf(run) {
  if (!DOC.scenes.length) return [];
  const of = scene();
  const at = of.runs.findIndex((one) => one.run === run);
  const iou = Math.max(0, of.ious.indexOf(asked.iou));
  if (at < 0) return [];
  return timeline().map((seq) => [seq, judged(of, at, seq, iou)]).filter(([, sweep]) => sweep && sweep.known);
}

const ofClass = (one) => !asked.klass || one.klass === asked.klass;

/** Widths of bins of ages, ms, and how many bins there are at most. */
const AGE_STEPS = [50, 100, 200, 500, 1000, 2000, 5000, 10000, 60000, Infinity], MOST_BINS = 8;
/** Objects of a bin that is drawn, at least. */
const FEW_OBJECTS = 10;

/** Recall of what the ego hardly sees, by the age of the oldest data that were fused. */
function ageChart(of) {
  const sweeps = DOC.runs.map((run, at) => (run.alone ? [] : sweepsOf(at)).filter(([, sweep]) => sweep.used.length).map(([, sweep]) => {
    const objects = sweep.objects.filter((object) => object.counts && ofClass(object) && object.hidden !== false);
    return [Math.max(...sweep.used.map(([, , age]) => age / 10)), objects.filter((object) => object.foundBy).length, objects.length];
  }));
  const ages = sweeps.flat().map(([age]) => age);
  const bin = (age, step) => Math.floor(age / step);
  const [low, high] = [ages.reduce((a, b) => Math.min(a, b), Infinity), ages.reduce((a, b) => Math.max(a, b), -Infinity)];
  const step = AGE_STEPS.find((width) => bin(high, width) - bin(low, width) < MOST_BINS);
  const first = bin(low, step);
  const names = ages.length ? Array.from({ length: bin(high, step) - first + 1 }, (_, at) => `${(first + at) * step}–${(first + at + 1) * step}`) : [];
  const series = sweeps.map((own, run) => {
    const points = names.map((name, at) => {
      const here = own.filter(([age]) => bin(age, step) - first === at);
      const [found, total] = [sum(here.map(([, n]) => n)), sum(here.map(([, , n]) => n))];
      return [at, found / total, `${found} of ${total}, ${name} ms`, total];
    });
    return seriesOf(run, points.filter(([, , , total]) => total >= FEW_OBJECTS), { dots: true });
  });
  return figure("Recall by age", `${of}; objects that the ego hardly sees, by the age of the oldest data fused, in this scene${scoreWords()}; ages with ${FEW_OBJECTS} objects or more`,
    DOC.runs.every((run) => run.result.mode === "offline") ? null : lines(series, { label: "age, ms", low: -0.2, high: names.length - 0.8, names }, { label: "", low: 0, high: 1 }),
    "Nothing is late: these runs are offline, or fuse nothing, or have too few objects.");
}

/** True, false and missed of each run, as the table counts them. */
function countsChart(of) {
  const rows = DOC.runs.map((run) => {
    const tables = Object.entries((run.result.accuracy || { sorted: { counts: {} } }).sorted.counts).filter(([klass]) => !asked.klass || klass === asked.klass);
    const all = tables.map(([, ious]) => ious[asked.iou]).filter(Boolean);
    const hits = sum(all.map((counts) => counts.true)), total = sum(all.map((counts) => counts.total));
    return { name: run.name, parts: [["found", hits, "var(--run0)"], ["missed", total - hits, "var(--line)"], ["false detections", sum(all.map((counts) => counts.false)), "var(--wrong)"]] };
  });
  const picture = stacks(rows, "", false);
  return figure("Found, missed, false", `${of}; counts at IoU ${asked.iou}, of all scores`,
    picture && el("div", {}, picture, partsKey([["found", "var(--run0)"], ["missed", "var(--line)"], ["false", "var(--wrong)"]])), "No run was scored.");
}

const WHY = [["found", "var(--run0)"], ["a box is there, but its IoU is too small", "var(--run4)"], ["its box has a lower score", "var(--run3)"], ["no box is there", "var(--wrong)"]];

/** Why objects were missed, over all sweeps of the scene. */
function missedChart(of) {
  const rows = DOC.runs.map((run, at) => {
    const counts = [0, 0, 0, 0];
    for (const [, sweep] of sweepsOf(at)) {
      for (const object of sweep.objects) {
        if (object.counts && ofClass(object)) counts[object.foundBy ? 0 : object.nearBox ? 1 : object.weakBox ? 2 : 3] += 1;
      }
    }
    return { name: run.name, parts: WHY.map(([what, color], part) => [what, counts[part], color]) };
  });
  const picture = stacks(rows, "objects", true);
  return figure("Why objects were missed", `${of}; all sweeps of this scene, at IoU ${asked.iou}${scoreWords()}`,
    picture && el("div", {}, picture, partsKey(WHY)), "No run has a recording with objects of this class.");
}

/** How exactly objects were found: how far the centres of boxes are off. */
function offsetChart(of) {
  const series = DOC.runs.map((run, at) => {
    const all = sorted(sweepsOf(at).flatMap(([, sweep]) => sweep.objects.filter((object) => object.counts && object.nearBox && ofClass(object))
      .map((object) => offBy(object.nearBox, object))));
    const share = (percent) => all[Math.min(all.length - 1, Math.floor(percent / 100 * all.length))];
    // The last few percent would stretch the axis.
    return seriesOf(at, all.length ? Array.from({ length: 99 }, (_, percent) => [share(percent), percent / 100]) : []);
  });
  const iou = DOC.scenes.length ? scene().ious[0] : "";
  return figure("How far boxes are off", `${of}; share of the objects found at IoU ${iou} whose box's centre is not further off, in this scene${scoreWords()}`,
    lines(series, { label: "m", from: 0 }, { label: "share", low: 0, high: 1 }), "No run has found an object of this class.");
}

// --- The map of hits and misses -----------------------------------------------------------------------------------

let maps = [];

function hitMaps() {
  if (!DOC.scenes.length) return figure("Map of hits and misses", "", null, "No run has a recording.", true);
  maps = scene().runs.slice(0, MOST_PANES).map((run) => {
    const canvas = el("canvas", { role: "img", "aria-label": `Hits and misses of ${DOC.runs[run.run].name}`, style: "height:300px" });
    return { run: run.run, canvas, box: el("div", { class: "pane", style: `--c:${runColor(run.run)}` }, el("div", { class: "head" }, el("b", {}, DOC.runs[run.run].name)), canvas) };
  });
  return figure("Map of hits and misses", `${sweepsInWords(scene())} of this scene from above: faint where an object was found, yellow where it was found though the ego has few points on it and others were fused, dashes where it was missed, crosses for false detections${scoreWords()}`,
    el("div", {}, el("div", { style: "display:grid;gap:8px;grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr))" }, maps.map((map) => map.box))), "", true);
}

function drawMaps() {
  const all = maps.map(({ run }) => sweepsOf(run));
  const places = all.map((sweeps) => sweeps.flatMap(([, sweep]) => [
    ...sweep.objects.filter((one) => one.counts && ofClass(one)).map((one) => [...inMap(sweep.pose, one.box[0], one.box[1], 0), one.fate]),
    ...sweep.boxes.filter((one) => one.fate === "false" && ofClass(one)).map((one) => [...inMap(sweep.pose, one.box[0], one.box[1], 0), "false"]),
  ]));
  if (!places.flat().length) return;
  const { turn } = extent();
  const [sin, cos] = [Math.sin(turn), Math.cos(turn)];
  for (const place of places.flat()) [place[0], place[1]] = [cos * place[0] - sin * place[1], sin * place[0] + cos * place[1]];
  const xs = places.flat().map(([x]) => x), ys = places.flat().map(([, y]) => y);
  const [left, right, low, high] = [quantile(xs, 0.01) - 5, quantile(xs, 0.99) + 5, quantile(ys, 0.01) - 5, quantile(ys, 0.99) + 5];
  maps.forEach(({ canvas }, at) => {
    const { width, height } = canvas.getBoundingClientRect();
    if (!width) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = paint.view;
    context.fillRect(0, 0, width, height);
    const scale = Math.min(width / (right - left), height / (high - low));
    const px = (x) => width / 2 + (x - (left + right) / 2) * scale, py = (y) => height / 2 - (y - (low + high) / 2) * scale;
    const order = ["hit", "added", "missed", "false"];
    for (const [x, y, , fate] of [...places[at]].sort((a, b) => order.indexOf(a[3]) - order.indexOf(b[3]))) {
      const [cx, cy] = [px(x), py(y)];
      context.beginPath();
      if (fate === "false") {
        context.moveTo(cx - 3, cy - 3); context.lineTo(cx + 3, cy + 3); context.moveTo(cx + 3, cy - 3); context.lineTo(cx - 3, cy + 3);
        stroke(context, paint.wrong, 1.2, [], 0.8);
      } else if (fate === "missed") {
        context.moveTo(cx - 3.5, cy); context.lineTo(cx + 3.5, cy);
        stroke(context, paint.wrong, 2, [], 0.75);
      } else {
        context.arc(cx, cy, 1.7, 0, 7);
        context.globalAlpha = fate === "added" ? 0.75 : 0.22;
        context.fillStyle = fate === "added" ? paint.added : paint.ink;
        context.fill();
        context.globalAlpha = 1;
      }
    }
    context.beginPath();
    context.moveTo(12, height - 12); context.lineTo(12 + 20 * scale, height - 12);
    stroke(context, paint.ink, 2);
    label(context, "20 m", 12, height - 18, paint.ink, "left", 400);
  });
}

// --- Messages and time --------------------------------------------------------------------------------------------

const FATE_COLORS = {
  used: "var(--run0)", skipped: "var(--run4)", over_limit: "var(--run5)", distrusted: "var(--run3)", stale: "var(--run1)",
  superseded: "var(--truth)", lost: "var(--wrong)", rejected: "var(--ink)", in_flight: "var(--line)", unaccounted: "var(--muted)",
};

function channelsOf(run) {
  return Object.entries(run.result.links).flatMap(([link, kinds]) => Object.entries(kinds).map(([kind, books]) => ({ link, kind, books })))
    .filter(({ kind }) => kind !== "agent_state");
}

function fateFigure() {
  const order = [...FATES, "unaccounted"];
  const rows = DOC.runs.flatMap((run) => {
    const channels = channelsOf(run).filter(({ books }) => known(books.used));
    const total = (fate) => sum(channels.map(({ books }) => Math.max(0, books[fate] || 0)));
    return channels.length ? [{ name: run.name, parts: order.map((fate) => [FATE_WORDS[fate] || fate, total(fate), FATE_COLORS[fate]]) }] : [];
  });
  const seen = order.filter((fate) => rows.some((row) => row.parts[order.indexOf(fate)][1] > 0));
  const picture = stacks(rows, "messages", true);
  return figure("What became of every message", "All messages to egos, states of agents aside", picture && el("div", {}, picture, partsKey(seen.map((fate) => [FATE_WORDS[fate] || fate, FATE_COLORS[fate]]))),
    "No message for fusion crossed a link in these runs.", true);
}

/** Channels that a flow has at most; the rest are one. */
const MOST_CHANNELS = 12;

/** Every message of a run as a flow: from the channel that it was sent on to what became of it. */
function flowFigure(run) {
  const order = [...FATES, "unaccounted"];
  const channels = channelsOf(run).filter(({ books }) => known(books.used) && books.sent > 0).sort((a, b) => b.books.sent - a.books.sent);
  const rows = channels.slice(0, MOST_CHANNELS).map(({ link, kind, books }) => [`${link}, ${kind}`, order.map((fate) => Math.max(0, books[fate] || 0))]);
  const rest = channels.slice(MOST_CHANNELS);
  if (rest.length) rows.push([`${rest.length} more channels`, order.map((fate) => sum(rest.map(({ books }) => Math.max(0, books[fate] || 0))))]);
  if (!rows.length) return null;
  const sinks = order.map((fate, at) => [FATE_WORDS[fate] || fate, at, FATE_COLORS[fate]]).filter(([, at]) => rows.some(([, values]) => values[at] > 0));
  return figure(`Flow of messages: ${run.name}`, "From sender, receiver and kind to what became of each message; the height is their number", el("div", { class: "wide" }, ribbons(rows, sinks)), "", true);
}

/** Ribbons from rows `[name, values]` to sinks `[name, place of its value, color]`. */
function ribbons(rows, sinks) {
  const [width, left, right, bar, gap, least] = [760, 250, 190, 10, 6, 16];
  const of = (at) => sum(rows.map(([, values]) => values[at]));
  const all = sum(sinks.map(([, at]) => of(at)));
  const scale = Math.max(140, 26 * Math.max(rows.length, sinks.length)) / all;
  // A small one is as high as its name, and its ribbons are in the middle of that.
  const stack = (values) => {
    let y = 4;
    return values.map((value) => {
      const tall = Math.max(value * scale, least);
      const place = { y: y + (tall - value * scale) / 2, middle: y + tall / 2, value };
      y += tall + gap;
      return { ...place, end: y };
    });
  };
  const from = stack(rows.map(([, values]) => sum(sinks.map(([, at]) => values[at])))), to = stack(sinks.map(([, at]) => of(at)));
  const height = Math.max(from.at(-1).end, to.at(-1).end);
  const words = sinks.map(([name, at]) => `${count(of(at))} ${name}`).join(", ");
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Of ${count(all)} messages: ${words}`, style: "min-width:560px;max-width:880px" });
  const [x0, x1] = [left + bar, width - right - bar], middle = (x0 + x1) / 2;
  const starts = from.map(({ y }) => y), ends = to.map(({ y }) => y);
  rows.forEach(([name, values], row) => sinks.forEach(([sink, at, color], place) => {
    const value = values[at], tall = value * scale;
    if (!value) return;
    const [y0, y1] = [starts[row], ends[place]];
    starts[row] += tall;
    ends[place] += tall;
    picture.append(svg("path", { d: `M${x0} ${y0}C${middle} ${y0} ${middle} ${y1} ${x1} ${y1}V${y1 + tall}C${middle} ${y1 + tall} ${middle} ${y0 + tall} ${x0} ${y0 + tall}Z`, fill: color, opacity: 0.55 },
      svg("title", {}, `${name}: ${count(value)} of ${count(from[row].value)} ${sink}`)));
  }));
  rows.forEach(([name], row) => {
    const { y, middle: at, value } = from[row];
    picture.append(svg("rect", { x: left, y, width: bar, height: Math.max(1, value * scale), fill: "var(--ink)" }),
      svg("text", { x: left - 6, y: at + 4, "text-anchor": "end", class: "ink" }, `${name.length > 30 ? name.slice(0, 29) + "…" : name}: ${count(value)}`, svg("title", {}, name)));
  });
  sinks.forEach(([name, , color], place) => {
    const { y, middle: at, value } = to[place];
    picture.append(svg("rect", { x: x1, y, width: bar, height: Math.max(1, value * scale), fill: color }),
      svg("text", { x: x1 + bar + 6, y: at + 4, class: "ink" }, `${name}: ${count(value)}`));
  });
  return picture;
}

/** KB that were sent to the ego in each second, of all senders. */
function bytesOverTime() {
  const series = DOC.runs.map((run, at) => {
    const of = DOC.scenes.length && scene().runs.find((one) => one.run === at);
    const seconds = new Map();
    for (const [, t, , bytes] of (of && of.carried) || []) seconds.set(t, (seconds.get(t) || 0) + bytes);
    const times = [...seconds.keys()].sort((a, b) => a - b);
    const points = [];
    // A second in which nothing was sent has no row; the first and the last are not whole.
    for (let t = times[0]; t <= times.at(-1); t += 1000) points.push([(t + 500) / 1000, (seconds.get(t) || 0) / 1000]);
    return seriesOf(at, points.length > 3 ? points.slice(1, -1) : points);
  });
  return figure("KB over time", "Sent to the ego for fusion in each whole second, in this scene; 1 KB is 1,000 bytes", lines(series, { label: "s" }, { label: "KB", low: 0 }),
    "Nothing was sent for fusion, or the recordings do not say when: run again with this version.");
}

function bytesFigure() {
  const rows = DOC.runs.map((run) => ({
    name: run.name,
    parts: channelsOf(run).map(({ link, kind, books }, at) => [`${link}, ${kind}`, books.bytes / 1000 / Math.max(1, run.result.frames.total), fill(at)]),
  }));
  return figure("KB for each sweep of the ego", "By channel, in the order of the table below; 1 KB is 1,000 bytes", stacks(rows, "KB", false), "Nothing was sent for fusion.");
}

function channelTable() {
  const rows = DOC.runs.flatMap((run) => channelsOf(run).map(({ link, kind, books }) => [run.name, link, kind, count(books.sent), count(books.used), count(books.lost),
    count(known(books.used) ? books.sent - books.used - books.lost : null), count(books.bytes / 1000)]));
  if (!rows.length) return null;
  return el("figure", { class: "span" }, el("figcaption", {}, "Channels"), el("div", { class: "wide" }, table(["run", "channel", "kind", "sent", "used", "lost", "not used", "KB"], rows.slice(0, 60))));
}

function cdf(title, what, pick, none) {
  const series = DOC.runs.map((run, at) => seriesOf(at, pick(run).map((value, percent) => [value, percent / 100])));
  return figure(title, what, lines(series, { label: "ms", from: 0 }, { label: "share", low: 0, high: 1 }), none);
}

/** Whether stages took time in a run. */
const hasLatency = (run) => run.result.mode !== "offline" && (run.result.mode === "realtime" || run.result.compute);

/** What results say of the machine that took this time. */
function machineWords() {
  const timed = DOC.runs.filter(hasLatency);
  const all = (of) => [...new Set(timed.map(of).filter(Boolean))];
  const [machines, isas] = [all((run) => run.timing.machine), all((run) => run.result.isa)];
  const where = machines.length ? `Times of runs in realtime are those of ${machines.join("; ")}` : "Times are what the compute profile charges";
  return `${where}${isas.length ? `; kernels of the networks: ${isas.join(", ")}` : ""}.`;
}

/** The stages on the way of the ego's boxes, in the order of the way: each after all of them that it takes from. */
function stagesInOrder() {
  const deep = new Map();
  for (const run of DOC.runs) {
    const stages = Object.keys(run.timing.joining);
    const own = new Map(stages.map((stage) => [stage, 0]));
    const inputs = (stage) => Object.entries(run.graph[stage] || {}).filter(([key]) => key.startsWith("inputs."))
      .flatMap(([, from]) => from.split(/[\s,]+/)).map((from) => from.split("/")[0]).filter((from) => own.has(from) && from !== stage);
    const before = new Map(stages.map((stage) => [stage, [...new Set(inputs(stage))]]));
    // As many rounds as the longest way has steps; a circle ends with them.
    for (let round = 1; round < stages.length; round++) {
      for (const stage of stages) own.set(stage, Math.max(own.get(stage), ...before.get(stage).map((from) => Math.min(own.get(from) + 1, stages.length))));
    }
    for (const [stage, depth] of own) deep.set(stage, Math.max(deep.get(stage) || 0, depth));
  }
  return [...deep.keys()].sort((a, b) => deep.get(a) - deep.get(b));
}

function stageFigure() {
  const stages = stagesInOrder();
  const rows = DOC.runs.filter(hasLatency).map((run) => ({
    name: run.name,
    parts: stages.flatMap((stage, at) => {
      const p50 = (of) => ((run.timing[of] || {})[stage] || {}).p50 || 0;
      const part = (what, of, share) => [`${stage}: ${what}`, p50(of), fill(at, share), String(at + 1)];
      return [part("waited for partners", "joining", 35), part("waited for the stage", "waiting", 65), part("computed", "latency", 100)];
    }),
  }));
  const picture = stacks(rows, "ms", false);
  return figure("Where the time goes", "Medians on the way of the ego's boxes; pale: waiting for partners, half: waiting for a busy stage, full: computing",
    picture && el("div", {}, picture, partsKey(stages.map((stage, at) => [`${at + 1} ${stage}`, fill(at)])), el("p", { class: "muted hint" }, machineWords())), "Stages take no time in these runs: they are offline, or virtual without --compute.", true);
}

function overTime() {
  const series = (pick) => DOC.runs.map((run, at) => seriesOf(at, sweepsOf(at).map(([, sweep]) => [sweep.t / 1000, pick(sweep)]).filter(([, value]) => known(value))));
  const oldest = (sweep) => (sweep.used.length ? Math.max(...sweep.used.map(([, , age]) => age / 10)) : null);
  const share = (sweep) => {
    const { hit, added, missed } = sweep.counts;
    return hit + added + missed ? (hit + added) / (hit + added + missed) : null;
  };
  return [
    figure("Age over time", "The oldest data fused for each sweep, in this scene; a gap: nothing was fused", gapped(series(oldest), { label: "s" }, { label: "ms", from: 0 }), "Nothing was fused, or no run has a recording."),
    bytesOverTime(),
    figure("Messages fused over time", "For each sweep, in this scene", lines(series((sweep) => sweep.used.length), { label: "s" }, { label: "", low: 0 }), "No run has a recording."),
    figure("Found share over time", `All classes, for each sweep, in this scene${scoreWords()}`, lines(series(share), { label: "s" }, { label: "", low: 0, high: 1 }), "No run has a recording."),
  ];
}

/** Shortest time without data of others that is listed, ms. */
const SILENT_MS = 1000;

/** Spans of a scene in which a run fused nothing for so long: first and last of its sweeps by place. */
function silences(sweeps) {
  if (!sweeps.some(([, sweep]) => sweep.used.length)) return [];
  const spans = [];
  sweeps.forEach(([, sweep], at) => {
    if (sweep.used.length) return;
    if (spans.length && spans.at(-1)[1] === at - 1) spans.at(-1)[1] = at;
    else spans.push([at, at]);
  });
  return spans.filter(([from, to]) => sweeps[to][1].t - sweeps[from][1].t >= SILENT_MS);
}

/** Found and all objects of sweeps. */
function foundIn(sweeps) {
  const total = (fates) => sum(sweeps.map(([, { counts }]) => sum(fates.map((fate) => counts[fate]))));
  const found = total(["hit", "added"]), all = found + total(["missed"]);
  return all ? `${(found / all).toFixed(3)} (${count(found)} of ${count(all)})` : NONE;
}

/** What it cost where nothing of others came: what was found then, in the rest of the scene, and by the other runs. */
function silenceTable() {
  const shown = DOC.runs.map((_, at) => at).filter((at) => sweepsOf(at).length).slice(0, MOST_PANES);
  const rows = DOC.runs.flatMap((run, at) => {
    const sweeps = run.alone ? [] : sweepsOf(at);
    return silences(sweeps).map(([from, to]) => {
      const [begin, end] = [sweeps[from][1].t, sweeps[to][1].t];
      const within = sweeps.slice(from, to + 1), rest = sweeps.filter((_, place) => place < from || place > to);
      const then = (other) => (other === at ? NONE : foundIn(sweepsOf(other).filter(([, { t }]) => t >= begin && t <= end)));
      const when = `${(begin / 1000).toFixed(1)} to ${(end / 1000).toFixed(1)} s`;
      return [run.name, el("button", { type: "button", title: "Show its begin in the player", onclick: () => show(sweeps[from][0], null) }, when),
        foundIn(within), foundIn(rest), ...(shown.length > 1 ? shown.map(then) : [])];
    });
  });
  if (!rows.length) return null;
  return el("figure", { class: "span" }, el("figcaption", {}, "Times without data of others", el("small", {}, `A second or longer in which nothing of others was fused: share of the objects that was found then, and in the rest of this scene${scoreWords()}${rows.length > 40 ? `; the first 40 of ${rows.length}` : ""}`)),
    el("div", { class: "wide" }, table(["run", "when", "found then", "found in the rest", ...(shown.length > 1 ? shown.map((other) => `found then by ${DOC.runs[other].name}`) : [])], rows.slice(0, 40))));
}

/** Lines that end where sweeps without a value are between. */
function gapped(series, x, y) {
  const steps = series.flatMap((one) => one.points.slice(1).map((point, at) => point[0] - one.points[at][0]));
  const usual = quantile(steps, 0.5) || Infinity;
  const parts = series.flatMap((one) => {
    const pieces = [];
    one.points.forEach((point, at) => {
      if (at === 0 || point[0] - one.points[at - 1][0] > 1.6 * usual) pieces.push([]);
      pieces.at(-1).push(point);
    });
    return pieces.map((points) => ({ ...one, points, dots: points.length === 1 }));
  });
  return lines(parts, x, y);
}

function drawFlows() {
  byId("flows").replaceChildren(...[
    silenceTable(), fateFigure(), ...DOC.runs.slice(0, MOST_PANES).map(flowFigure), bytesFigure(), ...overTime(),
    cdf("Ages of what was fused", "Share of all uses that are not older", (run) => run.ages, "Nothing was fused."),
    cdf("From sweep to boxes", "Share of all sweeps that are not slower", (run) => (hasLatency(run) ? run.quantiles.end_to_end || [] : []), "Stages take no time in these runs."),
    stageFigure(), channelTable(),
  ].filter(Boolean));
}
