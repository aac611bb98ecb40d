"use strict";
// The player: the sweeps of one scene in several runs on one clock, from above or in space, on plain canvases.

const FALSE = -1, NOT_COUNTED = -2, NOT_JUDGED = -3;
const MOST_PANES = 4;
/** What can be chosen: scores that boxes have at least, and how fast the log is played. */
const SCORES = [0, 0.3, 0.5, 0.7], SPEEDS = [0.25, 0.5, 1, 2, 4, 10];

/** What is shown. The address of the page keeps it. */
const state = {
  scene: 0, at: 0, runs: [], iou: 0, view: "top", follow: false, klass: "", agent: -1, picked: null, speed: 1,
  playing: false, hidden: new Set(), score: 0,
};
/** Where the viewer is: a place in the map (m), pixels for a metre, turns about the vertical and down (rad). */
const camera = { x: 0, y: 0, scale: 4, turn: 0, tilt: 0.55 };
const panes = [];
let clock = { from: 0, at: 0 };

const scene = () => DOC.scenes[state.scene];
const timelines = new Map();

/** Numbers of the sweeps of a scene by time. */
function timeline(of = scene()) {
  if (!timelines.has(of)) {
    const seqs = Object.keys(of.frames).map(Number);
    timelines.set(of, seqs.sort((a, b) => of.frames[a].t - of.frames[b].t));
  }
  return timelines.get(of);
}

/** How many of the recorded sweeps of a scene are on the page. */
function sweepsInWords(of) {
  const [here, recorded] = [timeline(of).length, Math.max(...of.runs.map((run) => run.recorded))];
  return here < recorded ? `${count(here)} of ${count(recorded)} recorded sweeps` : "All recorded sweeps";
}

/** The runs that are shown at first: the first, and beside it the ego alone, if there is one the one that it is compared with; else the second. */
function firstRuns() {
  const all = scene().runs, runs = all.map((_, run) => run);
  const { against } = DOC.runs[all[0].run];
  const alone = runs.slice(1).find((run) => (known(against) ? all[run].run === against : DOC.runs[all[run].run].alone));
  return alone === undefined ? runs.slice(0, 2) : [0, alone];
}

/** The number of a track as the log or the run has it. */
const trackName = (of, place) => (of.tracks || {})[place] ?? String(place);

const seqNow = () => timeline()[state.at];

const FATES_OF_BOXES = [
  ["hit", "found"], ["added", "found, though the ego has few points on it and others were fused"], ["false", "false"], ["missed", "missed"], ["other", "not counted"],
];

/** A sweep of a run as it is judged at an overlap and the chosen score: boxes, objects, counts. Kept, as many charts ask for it. */
const judgedSweeps = new Map();
function judged(of, run, seq, iou = state.iou) {
  const key = `${DOC.scenes.indexOf(of)}.${run}.${seq}.${iou}`;
  if (!judgedSweeps.has(key)) judgedSweeps.set(key, judge(of, of.runs[run], seq, iou));
  return judgedSweeps.get(key);
}

function judge(of, run, seq, iou) {
  const shared = of.frames[seq], frame = run.frames[seq];
  if (!frame) return null;
  const rows = frame.objects || shared.objects || [];
  const pose = frame.pose || (shared.poses || [])[0] || [0, 0, 0, 0];
  const used = frame.used || [];
  const objects = rows.map(([row, points], index) => ({
    kind: "object", index, klass: DOC.classes[row[0]], box: row.slice(1, 8), track: row[8], counts: row[9] === 1, points,
    own: points.length ? points[0] : null, foundBy: null, nearBox: null, weakBox: null,
    hidden: points.length ? points[0] < of.seen_points : null,
  }));
  const boxes = (frame.boxes || []).map((row, index) => {
    const code = row[9 + iou];
    const object = code >= 0 ? objects[code] : null;
    const [id, ...velocity] = row.slice(9 + of.ious.length);
    const box = { kind: "box", index, klass: DOC.classes[row[0]], score: row[1] / 1000, box: row.slice(2, 9), code, object, id: id ?? -1, velocity: velocity.length ? velocity : null };
    box.fate = code === FALSE ? "false" : code === NOT_COUNTED ? "other" : code === NOT_JUDGED ? "hit"
      : object.hidden && used.length ? "added" : "hit";
    // Boxes are matched by falling score: without those of lower scores the others find the same.
    const isWeak = box.score < state.score;
    if (object) object[isWeak ? "weakBox" : "foundBy"] = box;
    // Ious rise: what finds an object at the first alone is not near enough.
    if (row[9] >= 0 && !isWeak) objects[row[9]].nearBox = box;
    return box;
  }).filter((box) => box.score >= state.score);
  for (const object of objects) object.fate = !object.counts ? "other" : object.foundBy ? object.foundBy.fate : "missed";
  const n = (list, fate) => list.filter((one) => one.fate === fate).length;
  return {
    boxes, objects, pose, used, known: frame.known, processed: Boolean(frame.boxes), t: shared.t, key: shared.key,
    counts: { hit: n(boxes, "hit"), added: n(boxes, "added"), false: n(boxes, "false"), missed: n(objects, "missed") },
  };
}

/** Whether the chosen class and agent let a box or an object through. */
function chosen(one) {
  if (state.klass && one.klass !== state.klass) return false;
  if (state.agent >= 0) {
    const object = one.kind === "object" ? one : one.object;
    return Boolean(object && object.points[state.agent] > 0);
  }
  return true;
}

/** Whether the filters let a box or an object through. */
const passes = (one) => !state.hidden.has(one.fate) && chosen(one);

/** The counts of a sweep, of the chosen class and agent. */
function countsOf(sweep) {
  if (!state.klass && state.agent < 0) return sweep.counts;
  const n = (list, fate) => list.filter((one) => one.fate === fate && chosen(one)).length;
  return { hit: n(sweep.boxes, "hit"), added: n(sweep.boxes, "added"), false: n(sweep.boxes, "false"), missed: n(sweep.objects, "missed") };
}

/** The chosen class and agent in words that follow others. */
function filterWords() {
  return [state.klass && `of the class ${state.klass}`, state.agent >= 0 && `with points of ${scene().agents[state.agent].name}`].filter(Boolean).map((words) => `, ${words}`).join("");
}

// --- Places -------------------------------------------------------------------------------------------------------

/** A place of a body's frame in the map, m. */
function inMap(pose, x, y, z) {
  const c = Math.cos(pose[3] / 1000), s = Math.sin(pose[3] / 1000);
  return [(pose[0] + c * x - s * y) / 100, (pose[1] + s * x + c * y) / 100, (pose[2] + z) / 100];
}

/** The corners of a box in the map: four below, four above; the first two are in front. */
function corners(pose, [x, y, z, length, width, height, yaw]) {
  const c = Math.cos(yaw / 1000), s = Math.sin(yaw / 1000);
  const all = [];
  for (const up of [-0.5, 0.5]) {
    for (const [along, across] of [[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]]) {
      const dx = along * length, dy = across * width;
      all.push(inMap(pose, x + c * dx - s * dy, y + s * dx + c * dy, z + up * height));
    }
  }
  return all;
}

/** What brings places of the map to a canvas; `null` for what is behind the viewer. */
function projection(width, height) {
  const sin = Math.sin(camera.turn), cos = Math.cos(camera.turn);
  const [cx, cy] = [width / 2, height / 2];
  if (state.view === "top") {
    return (x, y) => {
      const dx = x - camera.x, dy = y - camera.y;
      return [cx + camera.scale * (cos * dx - sin * dy), cy - camera.scale * (sin * dx + cos * dy), 1];
    };
  }
  const [tiltSin, tiltCos] = [Math.sin(camera.tilt), Math.cos(camera.tilt)];
  const away = height / camera.scale * 1.1;
  return (x, y, z) => {
    const dx = x - camera.x, dy = y - camera.y;
    const right = cos * dx - sin * dy, ahead = sin * dx + cos * dy;
    const depth = away + ahead * tiltCos - z * tiltSin;
    if (depth < away * 0.04) return null;
    const k = camera.scale * away / depth;
    return [cx + right * k, cy - (ahead * tiltSin + z * tiltCos) * k, k / camera.scale];
  };
}

/** The place on the ground under a pixel, from above. */
function underPixel(pane, px, py) {
  const dx = (px - pane.width / 2) / camera.scale, dy = (pane.height / 2 - py) / camera.scale;
  const sin = Math.sin(camera.turn), cos = Math.cos(camera.turn);
  return [camera.x + cos * dx + sin * dy, camera.y - sin * dx + cos * dy];
}

/** How the scene lies: the turn that brings its long side across the screen, what it takes up then, m, and how far the ego goes. */
const extents = new Map();
function extent() {
  const of = scene();
  if (!extents.has(of)) extents.set(of, measured(of));
  return extents.get(of);
}

function measured(of) {
  const places = [];
  const seqs = timeline();
  const step = Math.max(1, Math.floor(seqs.length / 40));
  for (let at = 0; at < seqs.length; at += step) {
    const frame = of.frames[seqs[at]];
    for (const pose of frame.poses || []) if (pose) places.push([pose[0] / 100, pose[1] / 100]);
    const ego = (frame.poses || [])[0];
    for (const [row] of (ego && frame.objects) || []) if (row[9]) places.push(inMap(ego, row[1], row[2], 0));
  }
  const mean = (pick) => sum(places.map(pick)) / Math.max(1, places.length);
  const [mx, my] = [mean(([x]) => x), mean(([, y]) => y)];
  const [xx, yy, xy] = [mean(([x]) => (x - mx) ** 2), mean(([, y]) => (y - my) ** 2), mean(([x, y]) => (x - mx) * (y - my))];
  const apart = Math.hypot(xx - yy, 2 * xy);
  // A scene without a long side stays as the map has it.
  const turn = apart > 0.5 * (xx + yy) ? -Math.atan2(2 * xy, xx - yy) / 2 : 0;
  const [sin, cos] = [Math.sin(turn), Math.cos(turn)];
  const across = places.map(([x, y]) => cos * x - sin * y), up = places.map(([x, y]) => sin * x + cos * y);
  const ends = (values) => [quantile(values, 0.015) ?? -50, quantile(values, 0.985) ?? 50];
  const [[left, right], [low, high]] = [ends(across), ends(up)];
  const [u, v] = [(left + right) / 2, (low + high) / 2];
  const egos = seqs.map((seq) => (of.frames[seq].poses || [])[0]).filter(Boolean);
  const way = egos.length ? Math.hypot(egos[0][0] - egos.at(-1)[0], egos[0][1] - egos.at(-1)[1]) / 100 : 0;
  return { turn, width: right - left, height: high - low, center: [cos * u + sin * v, -sin * u + cos * v], way };
}

/** Looks at all that happens in the scene; where the ego goes far, at what is around it. */
function fitView() {
  const { turn, width, height, center, way } = extent();
  const pane = panes[0] || { width: 600, height: 480 };
  setFollow(way > 250);
  if (state.follow) {
    camera.scale = Math.min(pane.width, pane.height) / 120;
    return;
  }
  [camera.x, camera.y] = center;
  camera.turn = turn;
  camera.scale = within(Math.min(pane.width / (width + 16), pane.height / (height + 24)), 0.5, 20);
  if (state.view === "3d") camera.scale *= 1.3;
}

// --- Points -------------------------------------------------------------------------------------------------------

const CLOUD_TEXT = document.getElementById("points").textContent;
const clouds = new Map();
/** Decoded sweeps, the newest last; few are kept. */
const decoded = new Map();

/** Sweeps of an agent of a log by time. */
function cloudsOf(log, agent) {
  const key = JSON.stringify([log, agent]);
  if (!clouds.has(key)) {
    clouds.set(key, DOC.points.filter((part) => part.log === log && part.agent === agent).sort((a, b) => a.t - b.t));
  }
  return clouds.get(key);
}

function cloudNear(log, agent, t) {
  let best = null;
  for (const part of cloudsOf(log, agent)) if (!best || Math.abs(part.t - t) < Math.abs(best.t - t)) best = part;
  return best && Math.abs(best.t - t) <= 120 ? best : null;
}

/** The steps of a sweep that the page holds as text. */
function stepsOf([first, letters]) {
  const text = atob(CLOUD_TEXT.substr(first, letters));
  const bytes = new Uint8Array(text.length);
  for (let at = 0; at < text.length; at++) bytes[at] = text.charCodeAt(at);
  return new DataView(bytes.buffer);
}

/** x, y, z, x, y, z … in the map, m. */
function pointsOf(part) {
  if (decoded.has(part)) return decoded.get(part);
  const steps = part.steps || stepsOf(part.text);
  const points = new Float32Array(steps.byteLength / 2);
  for (let at = 0; at < points.length; at++) points[at] = part.from[at % 3] / 100 + steps.getInt16(2 * at, true) * 0.02;
  decoded.set(part, points);
  if (decoded.size > 64) decoded.delete(decoded.keys().next().value);
  return points;
}

/** Points as pixels, by the same sums as `projection`, which would make a list for each of a million points a second. */
function plot(points, pixels, width, height, ratio, low, high, ground) {
  const top = state.view === "top";
  const sin = Math.sin(camera.turn), cos = Math.cos(camera.turn);
  const tiltSin = top ? 1 : Math.sin(camera.tilt), tiltCos = top ? 0 : Math.cos(camera.tilt);
  const away = height / ratio / camera.scale * 1.1;
  const [cx, cy, scale] = [width / 2, height / 2, camera.scale * ratio];
  for (let at = 0; at < points.length; at += 3) {
    const dx = points[at] - camera.x, dy = points[at + 1] - camera.y, z = points[at + 2];
    const ahead = sin * dx + cos * dy;
    const depth = top ? away : away + ahead * tiltCos - z * tiltSin;
    if (depth < away * 0.04) continue;
    const k = scale * away / depth;
    const px = (cx + (cos * dx - sin * dy) * k) | 0, py = (cy - (ahead * tiltSin + (top ? 0 : z * tiltCos)) * k) | 0;
    if (px < 0 || py < 0 || px >= width - 1 || py >= height) continue;
    const place = py * width + px;
    if (z > ground) pixels[place] = pixels[place + 1] = high;
    else pixels[place] = low;
  }
}

/** Draws the ground and all points into the pixels of a canvas. */
function drawPixels(context, pane, t) {
  const { canvas } = pane;
  const ratio = canvas.width / pane.width;
  if (!DOC.points.length) {
    context.fillStyle = paint.view;
    context.fillRect(0, 0, pane.width, pane.height);
    return;
  }
  if (!pane.image || pane.image.width !== canvas.width || pane.image.height !== canvas.height) {
    pane.image = context.createImageData(canvas.width, canvas.height);
    pane.pixels = new Uint32Array(pane.image.data.buffer);
  }
  const { pixels } = pane;
  const [width, height] = [canvas.width, canvas.height];
  const word = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  const view = rgb(paint.view);
  pixels.fill(word(view));
  scene().agents.forEach((agent, number) => {
    if (state.agent >= 0 && state.agent !== number) return;
    const part = cloudNear(scene().log, agent.name, t);
    if (!part) return;
    const points = pointsOf(part);
    const hue = rgb(paint.agents[number % 6]);
    // Points near the ground recede, so that objects stand out.
    const mixed = (share) => word(hue.map((value, at) => Math.round(value * share + view[at] * (1 - share))));
    plot(points, pixels, width, height, ratio, mixed(0.35), mixed(0.9), part.from[2] / 100 + 0.3);
  });
  context.putImageData(pane.image, 0, 0);
}

// --- Drawing ------------------------------------------------------------------------------------------------------

function line(context, project, places, close) {
  context.beginPath();
  let pen = false;
  for (const place of close ? [...places, places[0]] : places) {
    const at = project(...place);
    if (!at) { pen = false; continue; }
    if (pen) context.lineTo(at[0], at[1]); else context.moveTo(at[0], at[1]);
    pen = true;
  }
}

function stroke(context, color, width, dash = [], alpha = 1) {
  context.globalAlpha = alpha;
  context.strokeStyle = color;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.stroke();
  context.globalAlpha = 1;
}

const STYLES = {
  hit: () => [paint.hit, 1.5, []],
  added: () => [paint.added, 2.2, []],
  false: () => [paint.wrong, 1.7, []],
  missed: () => [paint.wrong, 2, [5, 3]],
  other: () => [paint.muted, 1, [1, 3]],
  there: () => [paint.truth, 1.1, [2, 2]],
};

function drawBox(context, project, pose, box, style, cross) {
  const all = corners(pose, box);
  const [color, width, dash] = STYLES[style]();
  const flat = state.view === "top";
  const faces = flat ? [all.slice(0, 4)] : [all.slice(0, 4), all.slice(4)];
  if (style === "added") {
    line(context, project, flat ? all.slice(0, 4) : all.slice(4), true);
    context.globalAlpha = 0.35;
    context.fillStyle = paint["added-fill"];
    context.fill();
    context.globalAlpha = 1;
  }
  for (const face of faces) {
    line(context, project, face, true);
    stroke(context, color, width, dash);
  }
  if (!flat) {
    for (let at = 0; at < 4; at++) {
      line(context, project, [all[at], all[at + 4]]);
      stroke(context, color, width, dash);
    }
  }
  if (cross) {
    const top = flat ? all : all.slice(4);
    for (const [from, to] of [[0, 2], [1, 3]]) {
      line(context, project, [top[from], top[to]]);
      stroke(context, color, 1);
    }
  } else if (style !== "there" && style !== "missed") {
    // A tick ahead shows the heading.
    const middle = [0, 1, 2].map((axis) => (all[0][axis] + all[1][axis]) / 2);
    const heart = [0, 1, 2].map((axis) => (all[0][axis] + all[2][axis]) / 2);
    line(context, project, [middle, heart.map((value, axis) => value * 0.35 + middle[axis] * 0.65)]);
    stroke(context, color, width);
  }
}

function drawGround(context, project, pane) {
  const reach = Math.max(pane.width, pane.height) / camera.scale * (state.view === "top" ? 0.75 : 1.2);
  const gap = camera.scale > 12 ? 10 : camera.scale > 1.6 ? 20 : 100;
  const [west, south] = [Math.floor((camera.x - reach) / gap) * gap, Math.floor((camera.y - reach) / gap) * gap];
  for (let step = 0; step * gap <= 2 * reach + gap; step++) {
    for (const ends of [
      [[west + step * gap, south], [west + step * gap, south + 2 * reach]],
      [[west, south + step * gap], [west + 2 * reach, south + step * gap]],
    ]) {
      // In pieces, so that what is behind the viewer takes only its own piece away.
      const pieces = state.view === "top" ? 1 : 24;
      const way = Array.from({ length: pieces + 1 }, (_, at) => [0, 1].map((axis) => ends[0][axis] + (ends[1][axis] - ends[0][axis]) * at / pieces).concat(0));
      line(context, project, way);
      stroke(context, paint.grid, 1);
    }
  }
  return gap;
}

function label(context, text, x, y, color, align = "center", weight = 600) {
  context.font = `${weight} 12px system-ui, "Liberation Sans", "DejaVu Sans", sans-serif`;
  context.textAlign = align;
  context.lineWidth = 3.5;
  context.lineJoin = "round";
  context.setLineDash([]);
  context.strokeStyle = paint.view;
  context.strokeText(text, x, y);
  context.fillStyle = color;
  context.fillText(text, x, y);
}

/** Sweeps of a trail, and the smallest speed that is drawn, cm/s. */
const TRAIL = 20, MOVES = 50;

/** Where boxes that a run follows were before, their numbers, and how far they go in a second. */
function drawTracks(context, project, of, pane, sweep) {
  const shown = sweep.boxes.filter((box) => (box.id >= 0 || box.velocity) && passes(box));
  if (!shown.length) return;
  const trails = new Map(shown.map((box) => [box.id, []]));
  const seqs = timeline();
  for (let at = Math.max(0, state.at - TRAIL); at <= state.at; at++) {
    const then = judged(of, pane.run, seqs[at]);
    for (const box of then ? then.boxes : []) {
      if (box.id >= 0 && trails.has(box.id)) trails.get(box.id).push(inMap(then.pose, box.box[0], box.box[1], box.box[2] - box.box[5] / 2));
    }
  }
  for (const box of shown) {
    const [color] = STYLES[box.fate]();
    const trail = trails.get(box.id);
    if (box.id >= 0 && trail.length > 1) {
      line(context, project, trail);
      stroke(context, color, 1.6, [], 0.6);
    }
    const [x, y, z, , , height] = box.box;
    if (box.velocity && Math.hypot(...box.velocity) >= MOVES) {
      line(context, project, [inMap(sweep.pose, x, y, z), inMap(sweep.pose, x + box.velocity[0], y + box.velocity[1], z)]);
      stroke(context, color, 1.6, [2, 2]);
    }
    const at = project(...inMap(sweep.pose, x, y, state.view === "top" ? 0 : z + height / 2));
    // From far off numbers would cover each other.
    if (box.id >= 0 && at && camera.scale * at[2] > 3) label(context, trackName(of, box.id), at[0] + 9, at[1] - 7, color, "left", 500);
  }
}

function drawAgents(context, project, of, sweep, shared) {
  const poses = [...(shared.poses || [])];
  poses[0] = sweep ? sweep.pose : poses[0];
  const heard = new Map();
  for (const [agent, kind, age] of sweep ? sweep.used : []) {
    if (!heard.has(agent)) heard.set(agent, []);
    heard.get(agent).push(`${KINDS[kind]} ${ms(age / 10)}`);
  }
  const ego = poses[0] && project(...inMap(poses[0], 0, 0, 0));
  const labels = [];
  of.agents.forEach((agent, number) => {
    const pose = poses[number];
    if (!pose) return;
    const color = paint.agents[number % 6];
    const here = project(...inMap(pose, 0, 0, 0));
    if (!here) return;
    if (heard.has(number) && ego) {
      context.beginPath();
      context.moveTo(here[0], here[1]);
      context.lineTo(ego[0], ego[1]);
      stroke(context, color, 1.3, [1, 4], 0.9);
    }
    if (agent.footprint && !agent.roadside) {
      const [back, front, right, left] = agent.footprint;
      const middle = [(back + front) / 2, (left + right) / 2, 80, front - back, left - right, 160, 0];
      line(context, project, corners(pose, middle).slice(0, 4), true);
      context.fillStyle = color;
      context.fill();
    } else {
      context.beginPath();
      if (agent.roadside) context.rect(here[0] - 5, here[1] - 5, 10, 10);
      else context.arc(here[0], here[1], 6, 0, 7);
      context.fillStyle = color;
      context.fill();
    }
    const words = number === 0 ? `${agent.name} (ego)` : [agent.name, ...(heard.get(number) || [])].join(" · ");
    labels.push([words, here, color]);
  });
  // Names are moved up and down until none covers another.
  const taken = [];
  for (const [words, [x, y], color] of labels) {
    const half = words.length * 3.6;
    const free = (at) => !taken.some(([left, right, other]) => x - half < right && x + half > left && Math.abs(at - other) < 15);
    const at = [y - 12, y + 23, y - 28, y + 39, y - 44].find(free) ?? y - 12;
    taken.push([x - half, x + half, at]);
    label(context, words, x, at, color);
  }
}

function drawPane(pane) {
  const of = scene(), seq = seqNow();
  const { context } = pane;
  const shared = of.frames[seq];
  if (!shared) return;
  const sweep = judged(of, pane.run, seq);
  if (state.follow) {
    const ego = sweep ? sweep.pose : (shared.poses || [])[0];
    if (ego) { camera.x = ego[0] / 100; camera.y = ego[1] / 100; if (state.view === "top") camera.turn = Math.PI / 2 - ego[3] / 1000; }
  }
  drawPixels(context, pane, shared.t);
  const project = projection(pane.width, pane.height);
  const gap = drawGround(context, project, pane);
  pane.shown = [];
  if (sweep) {
    const [x0, x1, y0, y1] = of.region;
    line(context, project, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]].map(([x, y]) => inMap(sweep.pose, x, y, 0)), true);
    stroke(context, paint.truth, 1.2, [9, 5], 0.7);
    const show = (one, style, cross) => {
      if (!passes(one)) return;
      drawBox(context, project, sweep.pose, one.box, style, cross);
      pane.shown.push({ one, at: project(...inMap(sweep.pose, one.box[0], one.box[1], state.view === "top" ? 0 : one.box[2])) });
    };
    for (const object of sweep.objects) if (object.fate !== "missed") show(object, object.counts ? "there" : "other");
    for (const object of sweep.objects) if (object.fate === "missed") show(object, "missed");
    for (const box of sweep.boxes) show(box, box.fate, box.fate === "false");
    drawTracks(context, project, of, pane, sweep);
  }
  drawAgents(context, project, of, sweep, shared);
  const picked = pickedIn(pane, sweep);
  if (picked) {
    const at = project(...inMap(sweep.pose, picked.box[0], picked.box[1], state.view === "top" ? 0 : picked.box[2]));
    if (at) {
      context.beginPath();
      context.arc(at[0], at[1], Math.max(14, picked.box[3] / 100 * camera.scale * 0.75 * (at[2] || 1)), 0, 7);
      stroke(context, paint.accent, 2.5);
    }
  }
  if (state.view === "top") {
    const y = pane.height - 14;
    context.beginPath();
    context.moveTo(14, y); context.lineTo(14 + gap * camera.scale, y);
    stroke(context, paint.ink, 2);
    label(context, `${gap} m`, 14, y - 6, paint.ink, "left", 400);
  }
  if (!sweep || !sweep.processed) label(context, sweep ? "no boxes came for this sweep" : "this run has no such sweep", pane.width / 2, pane.height / 2, paint.wrong);
  pane.said.textContent = inWords(sweep);
}

/** What is shown of a sweep, counted: hidden fates are left out. */
function inWords(sweep) {
  if (!sweep) return NONE;
  if (!sweep.known) return `${sweep.boxes.filter(passes).length} boxes${filterWords()}, nothing known of what is there`;
  const { hit, added, missed, false: wrong } = countsOf(sweep);
  const shows = (fate) => !state.hidden.has(fate);
  const gained = shows("added") && added ? ` (${added} with few points of the ego)` : "";
  const found = (shows("hit") ? hit : 0) + (shows("added") ? added : 0);
  const parts = [(shows("hit") || shows("added")) && `${found} found${gained}`, shows("false") && state.agent < 0 && `${wrong} false`, shows("missed") && `${missed} missed`].filter(Boolean);
  return parts.length ? parts.join(" · ") + filterWords() : "all is hidden";
}

// --- The story of a box -------------------------------------------------------------------------------------------

/** What was clicked: a track goes through all sweeps and runs, a box without one is in its own sweep alone. */
function pickedIn(pane, sweep) {
  const picked = state.picked;
  if (!picked || !sweep) return null;
  if (picked.track >= 0) return sweep.objects.find((object) => object.track === picked.track) || null;
  if (picked.seq !== seqNow()) return null;
  if (picked.kind === "object") return sweep.objects[picked.index] || null;
  return picked.run === pane.run ? sweep.boxes.find((box) => box.index === picked.index) || null : null;
}

/** Moves the view to what is picked, if the first pane that has it does not show it. */
function lookAtPicked() {
  for (const pane of panes) {
    const sweep = judged(scene(), pane.run, seqNow());
    const picked = pickedIn(pane, sweep);
    if (!picked) continue;
    const [x, y, z] = inMap(sweep.pose, picked.box[0], picked.box[1], state.view === "top" ? 0 : picked.box[2]);
    const at = projection(pane.width, pane.height)(x, y, z);
    if (at && at[0] >= 0 && at[0] <= pane.width && at[1] >= 0 && at[1] <= pane.height) return;
    setFollow(false);
    [camera.x, camera.y] = [x, y];
    draw();
    keepPlace();
    return;
  }
}

function pick(pane, px, py) {
  const sweep = judged(scene(), pane.run, seqNow());
  let best = null, nearest = Infinity;
  for (const { one, at } of pane.shown || []) {
    if (!at) continue;
    const reach = Math.max(12, one.box[3] / 200 * camera.scale * (at[2] || 1));
    const far = Math.hypot(at[0] - px, at[1] - py);
    if (far < reach && far < nearest - 0.5) { best = one; nearest = far; }
  }
  if (!sweep || !best) state.picked = null;
  else {
    const object = best.kind === "object" ? best : best.object;
    const track = object ? object.track : -1;
    const kind = object ? "object" : "box";
    state.picked = { kind, run: pane.run, seq: seqNow(), index: (object || best).index, track };
  }
  draw();
  keepPlace();
}

const WORDS = {
  hit: "found", added: "found, though the ego has few points on it and others were fused", false: "false: no object is there", missed: "missed",
  other: "not counted: of another class, outside of the region, or too few points",
};

function story() {
  const box = byId("story");
  box.replaceChildren(el("h3", {}, "Story"));
  const stories = panes.map((pane) => [pane, judged(scene(), pane.run, seqNow())])
    .map(([pane, sweep]) => [pane, sweep, pickedIn(pane, sweep)]).filter(([, , one]) => one);
  if (!stories.length) {
    const gone = state.picked && state.picked.track >= 0 ? "It is not in this sweep." : "Click a box.";
    box.append(el("p", { class: "muted" }, gone));
    return;
  }
  const [, , first] = stories[0];
  const object = first.kind === "object" ? first : first.object;
  const facts = [["class", first.klass], ["size", first.box.slice(3, 6).map((cm) => (cm / 100).toFixed(1)).join(" × ") + " m"],
    ["distance from ego", (Math.hypot(first.box[0], first.box[1]) / 100).toFixed(1) + " m"]];
  if (object && object.track >= 0) facts.push(["track of the log", trackName(scene(), object.track)]);
  if (object && object.points.length) {
    scene().agents.forEach((agent, at) => facts.push([`points of ${agent.name}`, count(object.points[at] || 0)]));
  }
  box.append(list(facts));
  for (const [pane, sweep, one] of stories) {
    const found = one.kind === "box" ? one : one.foundBy;
    const lines = [["verdict", WORDS[one.fate]]];
    if (found) lines.push(["score", found.score.toFixed(3)]);
    if (found && found.id >= 0) lines.push(["track of the run", trackName(scene(), found.id)]);
    if (found && found.velocity) lines.push(["speed", (Math.hypot(...found.velocity) / 100).toFixed(1) + " m/s"]);
    if (found && found.object) lines.push(["centre off by", offBy(found, found.object).toFixed(2) + " m"]);
    if (one.fate === "missed") lines.push(["why", whyMissed(one)]);
    const sources = contributors(sweep, object);
    if (sources.length) lines.push(["could contribute", sources.join(", ")]);
    box.append(el("span", { class: "run" }, swatch(runColor(scene().runs[pane.run].run)), DOC.runs[scene().runs[pane.run].run].name), list(lines));
  }
}

/** How far the centre of a box is from that of an object, m. */
const offBy = (box, object) => Math.hypot(box.box[0] - object.box[0], box.box[1] - object.box[1]) / 100;

/** What kept an object that was missed from being found. */
function whyMissed(object) {
  if (object.nearBox) return `a box is there, but its IoU is too small: its centre is off by ${offBy(object.nearBox, object).toFixed(2)} m`;
  if (object.weakBox) return `its box has a score of ${object.weakBox.score.toFixed(3)}, less than chosen`;
  return "no box is there";
}

/** Agents that were fused for the sweep and have points on the object, with the age of what they sent. */
function contributors(sweep, object) {
  if (!sweep.used.length) return [];
  return sweep.used.filter(([agent]) => !object || !object.points.length || object.points[agent] > 0)
    .map(([agent, kind, age]) => `${scene().agents[agent].name} (${KINDS[kind]}, ${ms(age / 10)})`);
}

function list(facts) {
  return el("dl", {}, facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)]));
}

/** Who sent what for this sweep, how old it was, and what was not used around it. */
function usedNow() {
  const of = scene(), seq = seqNow(), t = of.frames[seq].t;
  const next = of.frames[timeline()[state.at + 1]];
  const box = byId("used");
  box.replaceChildren(el("h3", {}, "Sent by others"));
  let any = false;
  for (const pane of panes) {
    const run = of.runs[pane.run];
    const rows = (run.frames[seq] || {}).used || [];
    const not = run.messages.filter(([, , , fate, at]) => FATES[fate] !== "used" && at >= t && at < (next ? next.t : t + 100));
    if (DOC.runs[run.run].alone) continue;
    any = true;
    box.append(el("span", { class: "run" }, swatch(runColor(run.run)), DOC.runs[run.run].name));
    const lines = [
      ...rows.map(([agent, kind, age, number]) => [`${of.agents[agent].name}: ${KINDS[kind]} ${number}`, ms(age / 10)]),
      ...not.slice(0, 8).map(([agent, kind, number, fate]) => [`${of.agents[agent].name}: ${KINDS[kind]} ${number}`, FATE_WORDS[FATES[fate]] || FATES[fate]]),
      ...(not.length > 8 ? [[`${not.length - 8} more that were not used`, ""]] : []),
    ];
    box.append(el("ul", {}, lines.length ? lines.map(([what, how]) => el("li", {}, el("span", {}, what), el("span", {}, how)))
      : el("li", { class: "muted" }, "nothing was fused")));
  }
  if (!any) box.append(el("p", { class: "muted" }, "These runs fuse nothing of others."));
  else box.append(el("p", { class: "muted" }, "The time is the age when the ego used it; below 0 it was taken later than the ego's sweep."));
}

// --- Controls -----------------------------------------------------------------------------------------------------

let transport = {};

function makePanes() {
  const holder = byId("panes");
  panes.length = 0;
  holder.replaceChildren();
  const shown = state.runs.slice(0, MOST_PANES);
  // Of a wide scene two runs are one above the other.
  const { width, height, way } = extent();
  const wide = shown.length === 2 && way <= 250 && width > 1.7 * height;
  holder.style.setProperty("--columns", shown.length <= 1 || wide ? 1 : 2);
  holder.style.setProperty("--height", wide ? "264px" : shown.length <= 2 ? "480px" : "300px");
  for (const run of shown) {
    const canvas = el("canvas", { tabindex: "0", role: "img", "aria-label": `Sweep of ${DOC.runs[scene().runs[run].run].name}` });
    const said = el("span", { class: "muted" });
    const color = runColor(scene().runs[run].run);
    holder.append(el("div", { class: "pane", style: `--c:${color}` },
      el("div", { class: "head" }, el("b", {}, DOC.runs[scene().runs[run].run].name), said), canvas));
    const pane = { run, canvas, said, context: canvas.getContext("2d"), width: 0, height: 0 };
    panes.push(pane);
    handle(pane);
  }
  resize();
}

function resize() {
  const ratio = Math.min(2, window.devicePixelRatio || 1);
  for (const pane of panes) {
    const { width, height } = pane.canvas.getBoundingClientRect();
    if (!width) continue;
    [pane.width, pane.height] = [width, height];
    pane.canvas.width = Math.round(width * ratio);
    pane.canvas.height = Math.round(height * ratio);
    pane.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }
}

function handle(pane) {
  const { canvas } = pane;
  const touching = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", (event) => {
    try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer of a test has no device */ }
    touching.set(event.pointerId, event);
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = touching.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    moved += Math.abs(dx) + Math.abs(dy);
    if (touching.size === 2) {
      const other = [...touching.entries()].find(([id]) => id !== event.pointerId)[1];
      const span = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      zoom(span(event) / Math.max(1, span(before)));
    } else if (state.view === "3d" && !event.shiftKey) {
      camera.turn -= dx * 0.008;
      camera.tilt = within(camera.tilt + dy * 0.006, ...TILTS);
    } else {
      const [sin, cos] = [Math.sin(camera.turn), Math.cos(camera.turn)];
      const [right, ahead] = [-dx / camera.scale, dy / camera.scale / (state.view === "3d" ? Math.max(0.3, Math.sin(camera.tilt)) : 1)];
      camera.x += cos * right + sin * ahead;
      camera.y += -sin * right + cos * ahead;
      setFollow(false);
    }
    touching.set(event.pointerId, event);
    draw();
  });
  const end = (event) => {
    if (touching.delete(event.pointerId) && event.type === "pointerup" && moved < 5) {
      const { left, top } = canvas.getBoundingClientRect();
      pick(pane, event.clientX - left, event.clientY - top);
    }
    keepPlace();
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const { left, top } = canvas.getBoundingClientRect();
    const place = [event.clientX - left, event.clientY - top];
    const before = underPixel(pane, ...place);
    zoom(Math.exp(-event.deltaY * 0.0015));
    if (state.view === "top" && !state.follow) {
      const after = underPixel(pane, ...place);
      camera.x += before[0] - after[0];
      camera.y += before[1] - after[1];
    }
    draw();
    keepPlace();
  }, { passive: false });
}

const SCALES = [0.3, 80], TILTS = [0.08, 1.55];
const within = (value, least, most) => Math.max(least, Math.min(most, value));

function zoom(factor) {
  camera.scale = within(camera.scale * factor, ...SCALES);
}

function setFollow(follow) {
  state.follow = follow;
  if (transport.follow) transport.follow.setAttribute("aria-pressed", String(follow));
}

function toggleFollow() {
  setFollow(!state.follow);
  if (!state.follow) camera.turn = extent().turn;
  draw();
  keepPlace();
}

function setView(view) {
  if (view !== state.view) camera.scale *= view === "3d" ? 1.3 : 1 / 1.3;
  state.view = view;
  if (view === "top" && !state.follow) camera.turn = extent().turn;
  makeFilters();
  draw();
  keepPlace();
}

function makeFilters() {
  const of = scene();
  const scenes = DOC.scenes.map((one, at) => [at, `${one.log}, ego ${one.ego}`]);
  const classes = classesIn(of);
  const again = (change) => (value) => { change(value); filtersChosen(); };
  const views = segments([["top", "From above"], ["3d", "3D"]], state.view, setView);
  transport.views = views;
  transport.follow = el("button", { type: "button", "aria-pressed": String(state.follow), title: "The ego stays in the middle", onclick: toggleFollow }, "Follow ego");
  byId("filters").replaceChildren(
    ...(scenes.length > 1 ? [choice("Scene", scenes, state.scene, (at) => openScene(at))] : []),
    views, transport.follow,
    el("button", { type: "button", onclick: () => { fitView(); draw(); keepPlace(); } }, "Whole scene"),
    choice("Class", [["", "all"], ...classes], state.klass, again((value) => { state.klass = value; })),
    choice("Points of", [[-1, "anyone"], ...of.agents.map((agent, at) => [at, agent.name])], state.agent, again((value) => { state.agent = value; })),
    choice("Score", SCORES.map((least) => [least, least ? `≥ ${least}` : "any"]), state.score, again(setScore)),
    choice("IoU", of.ious.map((iou, at) => [at, iou]), state.iou, again((value) => { state.iou = value; })),
    ...(of.runs.length > 1 ? [runButtons(of)] : []),
    transport.note = el("span", { class: "hint muted" }),
  );
  noteFilters();
}

/** The classes of a scene, each with its name in the list: those that are scored in the order of the protocol, then others. */
function classesIn(of) {
  const few = (frames) => Object.values(frames).slice(0, 400);
  const there = new Set(of.runs.flatMap((run) => few(run.frames).flatMap((frame) => (frame.boxes || []).map((row) => DOC.classes[row[0]])))
    .concat(few(of.frames).flatMap((frame) => (frame.objects || []).map(([row]) => DOC.classes[row[0]]))));
  const scored = of.scored || [];
  const others = [...there].filter((name) => !scored.includes(name)).sort();
  // One that was chosen elsewhere can be taken off.
  const elsewhere = state.klass && !there.has(state.klass) ? [state.klass] : [];
  return [...[...scored.filter((name) => there.has(name)), ...elsewhere].map((name) => [name, name]), ...others.map((name) => [name, scored.length ? `${name} (not scored)` : name])];
}

/** What a filter hides without its being asked for. */
function noteFilters() {
  transport.note.textContent = state.agent >= 0 ? "False boxes are not shown: no object is there, so nobody has points on one." : "";
}

/** Hears that another class or agent was chosen. */
let filtersChanged = () => {};

function filtersChosen() {
  noteFilters();
  draw();
  drawStrip();
  keepPlace();
  filtersChanged();
}

/** Chooses a score: boxes of lower ones are as if they were not there. */
function setScore(score) {
  if (score === state.score) return;
  state.score = score;
  judgedSweeps.clear();
  drawStrip();
  sceneOpened();
}

const scoreWords = () => (state.score ? `, boxes of scores ≥ ${state.score}` : "");

/** The score to begin with: boxes of low scores are mostly false, but some networks give no higher ones. */
function firstScore() {
  const of = scene(), iou = Math.max(0, of.ious.indexOf(DOC.iou));
  const share = (run) => {
    const hits = Object.values(run.frames).flatMap((frame) => (frame.boxes || []).filter((row) => row[9 + iou] >= 0));
    return hits.length ? hits.filter((row) => row[1] >= 300).length / hits.length : 1;
  };
  return of.runs.every((run) => share(run) >= 0.8) ? 0.3 : 0;
}

function runButtons(of) {
  return el("span", { class: "tools", style: "margin:0" }, of.runs.map((run, at) => {
    const button = el("button", { type: "button", "aria-pressed": String(state.runs.includes(at)), onclick: () => {
      const has = state.runs.includes(at);
      if (has && state.runs.length === 1) return;
      state.runs = has ? state.runs.filter((other) => other !== at) : [...state.runs, at].slice(-MOST_PANES).sort((a, b) => a - b);
      makeFilters(); makePanes(); draw(); drawStrip(); keepPlace();
    } }, swatch(runColor(run.run)), DOC.runs[run.run].name);
    return button;
  }));
}

function makeTransport() {
  const last = timeline().length - 1;
  transport.play = el("button", { type: "button", class: "play", "aria-label": "Play", onclick: () => play(!state.playing) }, "▶");
  transport.slider = el("input", { type: "range", min: 0, max: Math.max(0, last), value: state.at, "aria-label": "Sweep", oninput: () => { play(false); seek(Number(transport.slider.value)); } });
  transport.time = el("output", {});
  byId("transport").replaceChildren(
    el("button", { type: "button", "aria-label": "One sweep back", onclick: () => step(-1) }, "‹"), transport.play,
    el("button", { type: "button", "aria-label": "One sweep on", onclick: () => step(1) }, "›"),
    transport.slider, transport.time,
    choice("Speed", SPEEDS.map((speed) => [speed, { 0.25: "¼", 0.5: "½" }[speed] || String(speed)]), state.speed, (speed) => { state.speed = speed; restartClock(); keepPlace(); }),
  );
}

/** Whether a run follows boxes over time. */
const hasTracks = (of) => of.runs.some((run) => Object.values(run.frames).some((frame) => (frame.boxes || []).some((row) => row[9 + of.ious.length] >= 0)));

function makeLegend() {
  const line = (color, dash, width = 2, fill = "none") => svg("svg", { width: 26, height: 14, "aria-hidden": "true" },
    svg("rect", { x: 2, y: 2, width: 22, height: 10, fill, "fill-opacity": 0.4, stroke: `var(--${color})`, "stroke-width": width, "stroke-dasharray": dash }),
    color === "wrong" && !dash ? svg("path", { d: "M2 2L24 12M24 2L2 12", stroke: "var(--wrong)" }) : null);
  const marks = [
    ["hit", line("hit", ""), "found"], ["added", line("added", "", 2, "var(--added-fill)"), `found, though the ego has fewer than ${scene().seen_points} points on it and others were fused`],
    ["false", line("wrong", ""), "false"], ["missed", line("wrong", "5 3"), "missed object"],
    [null, line("truth", "2 2", 1.2), "object that was found"], ["other", line("muted", "1 3", 1), "not counted"],
    ...(hasTracks(scene()) ? [[null, svg("svg", { width: 26, height: 14, "aria-hidden": "true" }, svg("path", { d: "M1 11C9 11 14 4 25 4", fill: "none", stroke: "var(--hit)", "stroke-width": 1.6, opacity: 0.6 })),
      "where a box that the run follows was in the 20 sweeps before, with its number; dashes: how far it goes in a second"]] : []),
  ];
  byId("legend").replaceChildren(...marks.map(([fate, mark, words]) => el("span", {}, fate
    ? el("label", { style: "display:inline-flex;gap:6px;align-items:center" }, el("input", { type: "checkbox", checked: !state.hidden.has(fate), onchange: (event) => {
      if (event.target.checked) state.hidden.delete(fate); else state.hidden.add(fate);
      draw(); drawStrip(); keepPlace();
    } }), mark, words) : [mark, words])));
}

/** Found share of the objects over time, a line for each run; a click goes there. */
function drawStrip() {
  const of = scene(), seqs = timeline();
  const [width, height] = [1000, 56];
  if (!seqs.length) return;
  const [start, end] = [of.frames[seqs[0]].t, of.frames[seqs.at(-1)].t];
  const x = (t) => 6 + (width - 12) * (t - start) / Math.max(1, end - start);
  const all = state.runs.map((run) => seqs.map((seq) => [of.frames[seq].t, judged(of, run, seq)]).filter(([, sweep]) => sweep && sweep.known)
    .map(([t, sweep]) => [t, countsOf(sweep)]).map(([t, counts]) => [t, (counts.hit + counts.added) / (counts.hit + counts.added + counts.missed)]).filter(([, share]) => Number.isFinite(share)));
  const least = Math.floor(10 * all.flat().reduce((low, [, share]) => Math.min(low, share), 0.9)) / 10;
  const y = (share) => 50 - 44 * (share - least) / (1 - least);
  const drawn = all.map((points, at) => (points.length ? svg("path", { d: "M" + points.map(([t, share]) => `${x(t).toFixed(1)} ${y(share).toFixed(1)}`).join("L"),
    fill: "none", stroke: runColor(of.runs[state.runs[at]].run), "stroke-dasharray": runDash(of.runs[state.runs[at]].run), "stroke-width": 1.6, "vector-effect": "non-scaling-stroke" }) : null));
  transport.cursor = svg("line", { y1: 0, y2: height, stroke: "var(--accent)", "stroke-width": 2, "vector-effect": "non-scaling-stroke" });
  transport.x = x;
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": "Found share of the objects over time" },
    [least, 1].map((share) => svg("line", { x1: 0, x2: width, y1: y(share), y2: y(share), class: "axis" })), drawn, transport.cursor);
  drawing.addEventListener("click", (event) => {
    const { left, width: wide } = drawing.getBoundingClientRect();
    const t = start + (end - start) * ((event.clientX - left) / wide * width - 6) / (width - 12);
    play(false);
    seek(seqs.reduce((best, seq, at) => (Math.abs(of.frames[seq].t - t) < Math.abs(of.frames[seqs[best]].t - t) ? at : best), 0));
  });
  byId("strip").replaceChildren(drawing, el("p", { class: "hint muted" }, `Found share of the objects in each sweep${filterWords()}${scoreWords()}${state.hidden.size ? ", with what is hidden" : ""}: from ${least} (lower line) to 1 (upper line). Click to go there.`));
  moveCursor();
}

function moveCursor() {
  if (!transport.cursor) return;
  const x = transport.x(scene().frames[seqNow()].t).toFixed(1);
  transport.cursor.setAttribute("x1", x);
  transport.cursor.setAttribute("x2", x);
}

// --- Time ---------------------------------------------------------------------------------------------------------

function seek(at) {
  state.at = Math.max(0, Math.min(timeline().length - 1, at));
  draw();
  if (!state.playing) keepPlace();
}

function step(by) {
  play(false);
  seek(state.at + by);
}

function restartClock() {
  clock = { from: performance.now(), at: scene().frames[seqNow()].t };
}

/** Hears that somebody plays, stops or goes elsewhere. */
let placeChosen = () => {};

function play(on) {
  placeChosen(on);
  if (on === state.playing) return;
  state.playing = on;
  transport.play.textContent = on ? "❚❚" : "▶";
  transport.play.setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on) { keepPlace(); return; }
  if (state.at >= timeline().length - 1) seek(0);
  restartClock();
  requestAnimationFrame(tick);
}

/** Pictures that were drawn while playing; a test reads how many a second holds. */
const played = { pictures: 0 };

function tick(now) {
  if (!state.playing) return;
  const of = scene(), seqs = timeline();
  const t = clock.at + (now - clock.from) * state.speed;
  let at = state.at;
  while (at + 1 < seqs.length && of.frames[seqs[at + 1]].t <= t) at += 1;
  if (at !== state.at) state.at = at;
  draw();
  played.pictures += 1;
  if (at >= seqs.length - 1) { play(false); return; }
  requestAnimationFrame(tick);
}

function draw() {
  if (!panes.length) return;
  panes.forEach(drawPane);
  const seq = seqNow(), frame = scene().frames[seq];
  if (transport.drawn === `${state.scene}.${seq}` && state.playing) return;
  transport.drawn = `${state.scene}.${seq}`;
  transport.slider.max = timeline().length - 1;
  transport.slider.value = state.at;
  transport.time.textContent = `${(frame.t / 1000).toFixed(2)} s · sweep ${seq}${frame.key ? "" : ", not scored"}`;
  moveCursor();
  story();
  usedNow();
}

function openScene(at) {
  play(false);
  state.scene = at;
  state.picked = null;
  state.agent = -1;
  state.at = 0;
  state.iou = Math.max(0, scene().ious.indexOf(DOC.iou));
  state.runs = firstRuns();
  setUp();
  fitView();
  draw();
  keepPlace();
  sceneOpened();
}

function setUp() {
  makeFilters();
  makePanes();
  makeTransport();
  makeLegend();
  drawStrip();
}

/** Goes to a sweep and picks an object there; looks at it where it is out of view. */
function show(seq, picked) {
  play(false);
  state.picked = picked;
  seek(Math.max(0, timeline().indexOf(seq)));
  lookAtPicked();
  byId("player").scrollIntoView();
  // Keys are for the player from now on, not for what was clicked.
  if (panes.length) panes[0].canvas.focus({ preventScroll: true });
}

function onKey(event) {
  if (/^(SELECT|TEXTAREA)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  const range = event.target.tagName === "INPUT" && event.target.type === "range";
  if (event.key === " " && !/^(BUTTON|SUMMARY|A)$/.test(event.target.tagName) && event.target.type !== "checkbox") play(!state.playing);
  else if (event.key === "ArrowRight" && !range) step(event.shiftKey ? 10 : 1);
  else if (event.key === "ArrowLeft" && !range) step(event.shiftKey ? -10 : -1);
  else if (event.key === "3") setView(state.view === "3d" ? "top" : "3d");
  else if (event.key === "f") toggleFollow();
  else return;
  event.preventDefault();
}

// --- The address --------------------------------------------------------------------------------------------------

/** What else the address keeps: { name, value: () => text, take: (text) => …, again: () => … }; an empty text is not written. */
const alsoKept = [];
let keeping = 0;
function keepPlace() {
  clearTimeout(keeping);
  keeping = setTimeout(() => {
    const place = new URLSearchParams();
    for (const { name, value } of alsoKept) if (value()) place.set(name, value());
    if (!byId("player").hidden) keepSweep(place);
    try { history.replaceState(null, "", "#" + place); } catch { /* some viewers keep no address */ }
  }, 150);
}

/** What the player shows, as a part of the address. */
function keepSweep(place) {
  place.set("scene", state.scene);
  place.set("sweep", seqNow());
  place.set("runs", state.runs.join("."));
  if (state.view !== "top") place.set("view", state.view);
  if (state.follow) place.set("follow", 1);
  if (state.klass) place.set("class", state.klass);
  if (state.agent >= 0) place.set("agent", state.agent);
  place.set("score", state.score);
  place.set("iou", state.iou);
  if (state.speed !== 1) place.set("speed", state.speed);
  if (state.hidden.size) place.set("hide", [...state.hidden].join("."));
  if (state.picked) place.set("pick", [state.picked.kind, state.picked.run, state.picked.seq, state.picked.index, state.picked.track].join("."));
  place.set("at", [camera.x, camera.y, camera.scale, camera.turn, camera.tilt].map((value) => value.toFixed(2)).join(","));
}

/** Takes up what else the address keeps. */
function takeOthers() {
  const place = new URLSearchParams(location.hash.slice(1));
  for (const { name, take } of alsoKept) take(place.get(name) || "");
}

/** Takes up the place that the address names; what it does not name stays. */
function takePlace() {
  const place = new URLSearchParams(location.hash.slice(1));
  const number = (name, least, most) => {
    const value = Number(place.get(name));
    return place.has(name) && Number.isFinite(value) && value >= least && value <= most ? value : null;
  };
  if (!place.has("sweep")) return false;
  const whole = (name, least, most) => { const value = number(name, least, most); return Number.isInteger(value) ? value : null; };
  const oneOf = (name, known, otherwise) => (known.includes(number(name, -Infinity, Infinity)) ? Number(place.get(name)) : otherwise);
  state.scene = whole("scene", 0, DOC.scenes.length - 1) ?? 0;
  const at = timeline().indexOf(number("sweep", 0, Number.MAX_SAFE_INTEGER));
  state.at = Math.max(0, at);
  const runs = (place.get("runs") || "x").split(".").map(Number).filter((run) => scene().runs[run]);
  state.runs = runs.length ? [...new Set(runs)].slice(0, MOST_PANES) : firstRuns();
  state.view = place.get("view") === "3d" ? "3d" : "top";
  state.follow = place.has("follow");
  state.klass = DOC.classes.includes(place.get("class")) ? place.get("class") : "";
  state.agent = whole("agent", 0, scene().agents.length - 1) ?? -1;
  state.score = oneOf("score", SCORES, firstScore());
  state.iou = whole("iou", 0, scene().ious.length - 1) ?? Math.max(0, scene().ious.indexOf(DOC.iou));
  state.speed = oneOf("speed", SPEEDS, 1);
  state.hidden = new Set((place.get("hide") || "").split(".").filter((fate) => FATES_OF_BOXES.some(([known]) => known === fate)));
  const [kind, run, seq, index, track] = (place.get("pick") || "").split(".");
  state.picked = kind === "object" || kind === "box" ? { kind, run: Number(run), seq: Number(seq), index: Number(index), track: Number(track) } : null;
  const eye = (place.get("at") || "").split(",").map(Number);
  if (eye.length === 5 && eye.every(Number.isFinite)) [camera.x, camera.y, camera.scale, camera.turn, camera.tilt] = eye;
  [camera.scale, camera.tilt] = [within(camera.scale, ...SCALES), within(camera.tilt, ...TILTS)];
  return true;
}

/** Goes to another address of the same page. */
function changePlace() {
  const [before, score] = [state.scene, state.score];
  play(false);
  takeOthers();
  for (const again of new Set(alsoKept.map(({ again }) => again))) again();
  if (!takePlace()) return;
  judgedSweeps.clear();
  setUp();
  draw();
  if (state.scene !== before || state.score !== score) sceneOpened();
}

let sceneOpened = () => {};

function startPlayer() {
  takeOthers();
  if (!DOC.scenes.length || !DOC.scenes.some((one) => timeline(one).length && one.runs.length)) return;
  byId("player").hidden = false;
  if (takePlace()) {
    setUp();
    draw();
  } else {
    state.iou = Math.max(0, scene().ious.indexOf(DOC.iou));
    state.runs = firstRuns();
    state.score = firstScore();
    state.at = best();
    setUp();
    fitView();
    draw();
  }
  addEventListener("keydown", onKey);
  addEventListener("hashchange", changePlace);
  new ResizeObserver(() => { resize(); draw(); }).observe(byId("panes"));
  repainted.push(draw, makeLegend);
}

/** The scored sweep, without any of them the sweep, in which cooperation added most. */
function best() {
  const of = scene();
  let [most, at] = [-1, 0];
  const anyScored = timeline().some((seq) => of.frames[seq].key);
  timeline().forEach((seq, number) => {
    if (anyScored && !of.frames[seq].key) return;
    const added = sum(of.runs.map((_, run) => judged(of, run, seq)).filter(Boolean).map((sweep) => sweep.counts.added));
    if (added > most) [most, at] = [added, number];
  });
  return at;
}
