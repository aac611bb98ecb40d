// The player: time, what boxes became, filters, places on the screen, the address.

import assert from "node:assert/strict";
import test from "node:test";

import { open } from "./browser.mjs";
import { report, run, scene } from "./documents.mjs";

const opened = (more = {}) => open({ data: report({ scenes: [scene()] }), ...more });
const close = (found, expected, within = 1e-9) => found.forEach((value, at) => assert.ok(Math.abs(value - expected[at]) <= within, `${found} is not ${expected}`));
/** A value of the page as one of this file: objects of another context are never equal. */
const plain = (value) => JSON.parse(JSON.stringify(value));

test("the player opens at the sweep in which cooperation added most, with the ego alone beside the first run", () => {
  const page = opened();
  assert.deepEqual(plain(page.value("state.runs")), [0, 1]);
  assert.equal(page.value("state.at"), 3);
  assert.equal(page.byId("player").hidden, false);
  assert.equal(open({ data: report() }).byId("player").hidden, true, "without a scene there is none");
});

test("playing follows the clock of the log at any speed, and stops with the last sweep", () => {
  const page = opened();
  page.value("seek(0)");
  page.value("play(true)");
  page.play(340);
  assert.equal(page.value("state.at"), 3);
  page.value("play(false)");
  page.play(500);
  assert.equal(page.value("state.at"), 3, "it stands");
  page.value("seek(0)");
  page.value("state.speed = 4");
  page.value("play(true)");
  page.play(120);
  assert.equal(page.value("state.at"), 4, "four times as fast");
  page.play(400);
  assert.deepEqual(plain(page.value("[state.at, state.playing]")), [9, false]);
  page.value("play(true)");
  assert.equal(page.value("state.at"), 0, "it begins anew");
});

test("a change of speed goes on from the sweep that is shown", () => {
  const page = opened();
  page.value("seek(0)");
  page.value("play(true)");
  page.play(400);
  const select = page.byId("transport").all("select")[0];
  Object.defineProperty(select, "selectedIndex", { value: 0 });
  select.dispatch("change");
  assert.equal(page.value("state.speed"), 0.25);
  page.play(380);
  assert.equal(page.value("state.at"), 4);
  page.play(40);
  assert.equal(page.value("state.at"), 5);
});

test("a gap in the log lasts as long as it lasted", () => {
  const of = scene();
  for (let seq = 5; seq < 10; seq++) of.frames[seq].t += 1000;
  const page = open({ data: report({ scenes: [of] }) });
  page.value("seek(4)");
  page.value("play(true)");
  page.play(1060);
  assert.equal(page.value("state.at"), 4);
  page.play(60);
  assert.equal(page.value("state.at"), 5);
});

test("sweeps are in the order of their times, and seeking stays within them", () => {
  const of = scene();
  [of.frames[3].t, of.frames[4].t] = [400, 300];
  const page = open({ data: report({ scenes: [of] }) });
  assert.deepEqual(plain(page.value("timeline()")), [0, 1, 2, 4, 3, 5, 6, 7, 8, 9]);
  for (const [to, at] of [[-7, 0], [99, 9], [4, 4]]) {
    page.value(`seek(${to})`);
    assert.equal(page.value("state.at"), at);
  }
});

test("keys step, play, turn the view and follow the ego", () => {
  const page = opened();
  page.value("seek(0)");
  page.press("ArrowRight");
  page.press("ArrowRight");
  page.press("ArrowLeft");
  assert.equal(page.value("state.at"), 1);
  page.press("ArrowRight", { shiftKey: true });
  assert.equal(page.value("state.at"), 9);
  page.press(" ");
  assert.equal(page.value("state.playing"), true);
  page.press(" ", { target: { tagName: "BUTTON" } });
  assert.equal(page.value("state.playing"), true, "a button takes its own keys");
  page.press("3");
  page.press("f");
  assert.deepEqual(plain(page.value("[state.view, state.follow]")), ["3d", true]);
  page.press("3", { ctrlKey: true });
  assert.equal(page.value("state.view"), "3d");
  page.value("clearTimeout(keeping)");
  page.value("keeping = 0");
  page.press("f");
  assert.equal(page.value("state.follow"), false);
  assert.equal(page.value("camera.turn"), page.value("extent().turn"), "the scene lies as before");
  assert.notEqual(page.value("keeping"), 0, "the address keeps it");
});

test("what became of boxes and objects depends on the overlap, the ego's points and what was fused", () => {
  const of = scene();
  // At IoU 0.5 the box of the vehicle has found nothing.
  of.runs[0].frames[4].boxes[0][10] = -1;
  const page = open({ data: report({ scenes: [of] }) });
  const fates = (run, seq, iou) => plain(page.value(`(({ boxes, objects, counts }) => [boxes.map((b) => b.fate), objects.map((o) => o.fate), counts])(judged(scene(), ${run}, ${seq}, ${iou}))`));
  assert.deepEqual(fates(0, 4, 0), [["hit", "added"], ["hit", "added"], { hit: 1, added: 1, false: 0, missed: 0 }]);
  assert.deepEqual(fates(0, 4, 1), [["false", "added"], ["missed", "added"], { hit: 0, added: 1, false: 1, missed: 1 }]);
  assert.deepEqual(fates(1, 5, 1), [["hit", "false"], ["hit", "missed"], { hit: 1, added: 0, false: 1, missed: 1 }]);
  delete of.runs[0].frames[4].used;
  const alone = open({ data: report({ scenes: [of] }) });
  assert.equal(alone.value("judged(scene(), 0, 4, 0).boxes[1].fate"), "hit", "nobody added it");
});

test("objects that do not count, and sweeps of which nothing is known, are no misses", () => {
  const of = scene();
  of.frames[2].objects[1][0][9] = 0;
  of.frames[3].objects = [];
  of.runs[0].frames[3] = { boxes: [[0, 900, 0, 0, 0, 1, 1, 1, 0, -3, -3]], known: false };
  of.runs[1].frames[3] = { boxes: [], known: false };
  of.runs[0].frames[6].boxes = null;
  const page = open({ data: report({ scenes: [of] }) });
  assert.deepEqual(plain(page.value("judged(scene(), 0, 2).counts")), { hit: 1, added: 0, false: 0, missed: 0 });
  assert.equal(page.value("judged(scene(), 0, 3).known"), false);
  assert.equal(page.value("inWords(judged(scene(), 0, 3))"), "1 boxes, nothing known of what is there");
  assert.equal(page.value("judged(scene(), 0, 6).processed"), false);
  page.value("seek(6)");
  const texts = page.value("panes[0].context.calls").filter(([name]) => name === "fillText").map(([, text]) => text);
  assert.ok(texts.includes("no boxes came for this sweep"), texts.join());
});

test("filters leave only the class, the agent's points, the score and the fates that they name", () => {
  const page = opened();
  const shown = (change) => {
    page.value("setScore(0)");
    page.value(`(({ score = 0, ...more }) => { Object.assign(state, { klass: "", agent: -1, hidden: new Set() }, more); setScore(score); })(${change})`);
    page.value("seek(5)");
    return plain(page.value("panes.map((pane) => pane.shown.map(({ one }) => `${one.kind} ${one.klass} ${one.fate}`))"));
  };
  assert.equal(shown("{}")[0].length, 4);
  assert.deepEqual(shown("{ klass: 'pedestrian' }"), [["object pedestrian added", "box pedestrian added"], ["object pedestrian missed"]]);
  assert.deepEqual(shown("{ agent: 0 }")[1], ["object vehicle hit", "box vehicle hit"], "false boxes have no points");
  assert.deepEqual(shown("{ score: 0.7, hidden: new Set(['hit']) }")[0], ["object pedestrian missed"], "as if its box were not there");
  assert.deepEqual(shown("{ hidden: new Set(['hit', 'missed']) }")[1], ["box vehicle false"]);
});

test("boxes of lower scores than chosen are as if they were not there, in every number", () => {
  const of = scene();
  for (const seq in of.runs[0].frames) of.runs[0].frames[seq].boxes.unshift([0, 200, 5000, 0, 80, 400, 200, 160, 0, -1, -1]);
  const page = open({ data: report({ scenes: [of] }) });
  assert.equal(page.value("state.score"), 0.3, "most that are found have higher scores");
  page.value("seek(5)");
  const said = () => page.value("panes[0].said.textContent");
  assert.equal(said(), "2 found (1 with few points of the ego) · 0 false · 0 missed");
  page.value("setScore(0)");
  page.value("draw()");
  assert.equal(said(), "2 found (1 with few points of the ego) · 1 false · 0 missed");
  page.value("setScore(0.7)");
  page.value("draw()");
  assert.equal(said(), "1 found · 0 false · 1 missed");
  page.value("state.picked = { kind: 'object', run: 0, seq: 5, index: 1, track: 8 }");
  page.value("draw()");
  assert.ok(page.byId("story").textContent.includes("its box has a score of 0.600, less than chosen"), page.byId("story").textContent);
  for (const run of of.runs) for (const seq in run.frames) run.frames[seq].boxes.forEach((row) => { row[1] = Math.min(row[1], 250); });
  assert.equal(open({ data: report({ scenes: [of] }) }).value("state.score"), 0, "all that this network finds has low scores");
});

test("a filter that a scene has no use for is still seen and can be taken off", () => {
  const page = opened({ hash: "#sweep=3&class=pedestrian" });
  page.value("state.klass = 'lorry'");
  page.value("makeFilters()");
  const options = page.byId("filters").all("option").filter((option) => "selected" in option.attributes).map((option) => option.textContent);
  assert.ok(options.includes("lorry"), options.join());
});

test("places of a body are brought to the map, and the corners of a box begin in front", () => {
  const page = opened();
  close(plain(page.value("inMap([100, 200, 50, 1571], 300, 0, 0)")), [1, 5, 0.5], 2e-3);
  const corners = plain(page.value("corners([0, 0, 0, 0], [1000, 0, 80, 400, 200, 160, 1571])"));
  close(corners[0].slice(0, 2), [9, 2], 2e-3);
  close(corners[1].slice(0, 2), [11, 2], 2e-3);
  assert.deepEqual(corners.map(([, , z]) => z), [0, 0, 0, 0, 1.6, 1.6, 1.6, 1.6]);
});

test("from above the place under a pixel is the one that is drawn there", () => {
  const page = opened();
  page.value("Object.assign(camera, { x: 12, y: -7, scale: 6.5, turn: 0.7 })");
  for (const [px, py] of [[0, 0], [400, 200], [799, 13]]) {
    const place = `underPixel({ width: 800, height: 400 }, ${px}, ${py})`;
    close(plain(page.value(`projection(800, 400)(...${place})`)), [px, py, 1]);
  }
});

test("in space near things are larger, higher ones are further up, and what is behind is not drawn", () => {
  const page = opened();
  page.value("Object.assign(camera, { x: 0, y: 0, scale: 4, turn: 0, tilt: 0.55 })");
  page.value("state.view = '3d'");
  const at = (x, y, z) => plain(page.value(`projection(800, 400)(${x}, ${y}, ${z})`));
  close(at(0, 0, 0), [400, 200, 1]);
  const [near, far] = [at(5, -30, 0), at(5, 30, 0)];
  assert.ok(near[2] > 1 && far[2] < 1 && near[1] > 200 && far[1] < 200 && near[0] > far[0]);
  assert.ok(at(0, 0, 3)[1] < 200);
  assert.equal(at(0, -200, 0), null);
});

test("points are drawn where boxes are, from above and in space", () => {
  for (const view of ["top", "3d"]) {
    const page = opened();
    page.value("Object.assign(camera, { x: 3, y: 4, scale: 5, turn: 0.4, tilt: 0.6 })");
    page.value(`state.view = '${view}'`);
    for (const place of [[3, 4, 0], [20, -6, 1.5], [-15, 9, 0.4], [3, -500, 0]]) {
      const pixels = new Uint32Array(1600 * 800);
      page.value("plot")(Float32Array.from(place), pixels, 1600, 800, 2, 1, 2, 0.3);
      const drawn = [...pixels.keys()].filter((pixel) => pixels[pixel]);
      const expected = page.value(`projection(800, 400)`)(...place);
      if (!expected || expected[1] > 400 || expected[1] < 0) { assert.deepEqual(drawn, []); continue; }
      const [x, y] = [drawn[0] % 1600, Math.floor(drawn[0] / 1600)];
      assert.ok(Math.abs(x - 2 * expected[0]) <= 1 && Math.abs(y - 2 * expected[1]) <= 1, `${view} ${place}: ${[x, y]} is not ${expected}`);
      assert.equal(pixels[drawn[0]], place[2] > 0.3 ? 2 : 1, "ground recedes");
    }
  }
});

test("sweeps of points are those that the program wrote", () => {
  // 1, -2, 0.5 and 0.02, 655.34, -655.36 m from the place, in steps of 2 cm; a test of `points.rs` has the same text.
  const text = "MgCc/xkAAQD/fwCA";
  const part = (agent, t) => ({ log: "log", agent, t, from: [1000, -500, 20], text: [4, text.length] });
  const page = open({ data: report({ scenes: [scene()], points: [part("cav1", 300), part("cav1", 0), part("rsu1", 0)] }), points: "AAAA" + text });
  const points = [...page.value("pointsOf(DOC.points[0])")];
  close(points, [11, -7, 0.7, 10.02, 650.34, -655.16], 1e-4);
  assert.equal(page.value("cloudNear('log', 'cav1', 110).t"), 0, "the nearest");
  assert.equal(page.value("cloudNear('log', 'cav1', 200).t"), 300);
  assert.equal(page.value("cloudNear('log', 'cav1', 430)"), null, "none within 120 ms");
  assert.equal(page.value("cloudNear('other', 'cav1', 0)"), null);
  for (let at = 0; at < 100; at++) page.value(`pointsOf({ steps: new DataView(new ArrayBuffer(6)), from: [0, 0, ${at}] })`);
  assert.equal(page.value("decoded.size"), 64, "few are kept");
});

test("a click picks the nearest box, and its object stays picked in other sweeps and runs", () => {
  const page = opened();
  page.value("seek(5)");
  const [x, y] = page.value("panes[0].shown.find(({ one }) => one.kind === 'box' && one.klass === 'pedestrian').at");
  page.value(`pick(panes[0], ${x + 2}, ${y})`);
  assert.deepEqual(plain(page.value("state.picked")), { kind: "object", run: 0, seq: 5, index: 1, track: 8 });
  const story = page.byId("story").textContent;
  for (const word of ["classpedestrian", "score0.600", "points of cav10", "points of rsu112", "rsu1 (boxes, 93 ms)", "missed"]) assert.ok(story.includes(word), `${word}: ${story}`);
  page.value("seek(1)");
  assert.equal(page.value("panes.map((pane) => pickedIn(pane, judged(scene(), pane.run, seqNow())).fate).join()"), "missed,missed");
  page.value("pick(panes[0], -500, -500)");
  assert.equal(page.value("state.picked"), null);
});

test("a false box is picked in its own sweep and run alone", () => {
  const page = opened();
  page.value("seek(5)");
  const [x, y] = page.value("panes[1].shown.find(({ one }) => one.fate === 'false').at");
  page.value(`pick(panes[1], ${x}, ${y})`);
  assert.deepEqual(plain(page.value("state.picked")), { kind: "box", run: 1, seq: 5, index: 1, track: -1 });
  const picked = () => page.value("panes.map((pane) => Boolean(pickedIn(pane, judged(scene(), pane.run, seqNow())))).join()");
  assert.equal(picked(), "false,true");
  page.value("seek(6)");
  assert.equal(picked(), "false,false");
});

test("a pick reaches as far as the box is large in space, and nothing behind the viewer", () => {
  const page = opened();
  page.value("seek(5)");
  page.value("panes[0].shown = [{ one: { box: [0, 0, 0, 1000], kind: 'box', index: 0 }, at: null }, { one: { box: [0, 0, 0, 1000], kind: 'box', index: 1, object: null }, at: [100, 100, 2] }]");
  page.value("camera.scale = 4");
  page.value("pick(panes[0], 100, 139)");
  assert.equal(page.value("state.picked && state.picked.index"), 1);
  page.value("panes[0].shown = [{ one: { box: [0, 0, 0, 1000], kind: 'box', index: 1, object: null }, at: [100, 100, 2] }]");
  page.value("pick(panes[0], 100, 141)");
  assert.equal(page.value("state.picked"), null);
});

test("the address keeps the place and brings it back", () => {
  const page = opened();
  page.value("seek(5)");
  page.press("3");
  page.value("Object.assign(state, { klass: 'pedestrian', agent: 1, score: 0.5, iou: 0, speed: 2, hidden: new Set(['false', 'other']), runs: [1] })");
  page.value("state.picked = { kind: 'object', run: 0, seq: 5, index: 1, track: 8 }");
  page.value("Object.assign(camera, { x: 1.25, y: -3.5, scale: 7.5, turn: 0.25, tilt: 1 })");
  page.value("keepPlace()");
  const before = page.addresses.length;
  page.wait(100);
  assert.equal(page.addresses.length, before, "not with every move");
  page.wait(100);
  const place = "[state.at, state.view, state.klass, state.agent, state.score, state.iou, state.speed, [...state.hidden], state.runs, state.picked, camera]";
  const hash = page.addresses.at(-1);
  const again = opened({ hash });
  assert.deepEqual(plain(again.value(place)), plain(page.value(place)), hash);
});

test("an address of another page is taken as far as it fits", () => {
  for (const hash of [
    "#sweep=5&scene=0.5&iou=0.5&agent=0.5&runs=0.0.7.x&score=0.4&speed=3", "#sweep=5&scene=9&iou=-1&agent=7&runs=&speed=1e9&class=lorry&hide=a.b&pick=box.x.y",
    "#sweep=5&at=0,0,0,0,0", "#sweep=5&at=1e300,0,1e-9,0,9&view=3d", "#sweep=5&at=1,2,NaN,0,0&pick=object.0.5.99.-1", "#sweep=%00&pick=.....&runs=__proto__",
  ]) {
    const page = opened({ hash });
    page.value("draw()");
    assert.ok([0, 5].includes(page.value("state.at")), hash);
    const { scale, tilt } = page.value("camera");
    assert.ok(scale >= 0.3 && scale <= 80 && tilt >= 0.08 && tilt <= 1.55, `${hash}: ${scale} ${tilt}`);
    assert.ok(Number.isInteger(page.value("state.iou")) && Number.isInteger(page.value("state.agent")), hash);
    const runs = plain(page.value("state.runs"));
    assert.equal(new Set(runs).size, runs.length, `${hash}: ${runs}`);
  }
  assert.deepEqual(plain(opened({ hash: "#sweep=5" }).value("state.runs")), [0, 1], "as without an address");
});

test("another address of the same page moves all of it", () => {
  const other = scene({ log: "other" });
  delete other.frames[0];
  const page = open({ data: report({ scenes: [scene(), other] }) });
  page.value("state.picked = { kind: 'object', run: 0, seq: 5, index: 1, track: 8 }");
  page.value("seek(0)");
  page.value("play(true)");
  const opened = page.value("(() => { let times = 0; const before = sceneOpened; sceneOpened = () => { times += 1; before(); }; return () => times; })()");
  page.goTo("#scene=1&sweep=4");
  assert.deepEqual(plain(page.value("[state.scene, seqNow(), state.playing, state.picked]")), [1, 4, false, null]);
  assert.equal(opened(), 1, "charts of the scene are drawn anew");
  page.goTo("#scene=1&sweep=5");
  assert.equal(opened(), 1);
});

test("a scene whose ego goes far is seen from the ego, and the next one as a whole again", () => {
  const far = scene({ log: "far" });
  for (const seq in far.frames) far.frames[seq].poses[0][1] = 4000 * seq;
  const page = open({ data: report({ scenes: [far, scene()] }) });
  const follows = () => plain(page.value("[state.follow, transport.follow.getAttribute('aria-pressed')]"));
  assert.deepEqual(follows(), [true, "true"]);
  page.value("openScene(1)");
  assert.deepEqual(follows(), [false, "false"]);
  page.value("openScene(0)");
  assert.deepEqual(follows(), [true, "true"]);
});

test("the long side of a scene lies across the screen", () => {
  const of = scene();
  for (const seq in of.frames) Object.assign(of.frames[seq], { poses: [[0, 2000 * seq, 0, 1571]], objects: [] });
  for (const run of of.runs) for (const seq in run.frames) run.frames[seq].boxes = [];
  const page = open({ data: report({ scenes: [of] }) });
  const { turn, width, height } = page.value("extent()");
  assert.ok(Math.abs(Math.abs(turn) - Math.PI / 2) < 1e-6 && width > 100 && height < 1, `${turn} ${width} ${height}`);
});

test("messages that were not used are listed with the sweep before which they came", () => {
  const of = scene();
  of.runs[0].messages = [[1, 2, 40, 6, 450], [1, 2, 41, 0, 450], [1, 2, 42, 4, 500]];
  const page = open({ data: report({ scenes: [of] }) });
  page.value("seek(4)");
  const words = page.byId("used").textContent;
  assert.ok(words.includes("rsu1: boxes 493 ms") && words.includes("rsu1: boxes 40lost on the link"), words);
  assert.ok(!words.includes("boxes 41") && !words.includes("boxes 42"), words);
});

test("names are text, whatever they hold", () => {
  const name = "<img src=x onerror=alert(1)>\"'&";
  const page = open({ data: report({ runs: [run(name), run("none", { alone: true })], scenes: [scene({ log: name })] }) });
  assert.ok(page.byId("panes").textContent.includes(name) && page.byId("title").textContent.includes(name));
  assert.deepEqual(page.byId("panes").all("img"), []);
});

test("the filters reach the counts in the head, the strip and what cooperation added", () => {
  const page = open({ data: report({ scenes: [scene()] }) });
  page.value("seek(5)");
  const heads = () => page.value("panes.map((pane) => pane.said.textContent)");
  const strip = () => page.byId("strip").all("path").map((path) => path.getAttribute("d"));
  const added = () => page.byId("added").all("tr").length;
  assert.deepEqual(plain(heads()), ["2 found (1 with few points of the ego) · 0 false · 0 missed", "1 found · 1 false · 1 missed"]);
  const [all, rows] = [strip(), added()];
  const choose = (change) => { page.value(`((change) => { change(); filtersChosen(); })(() => { ${change} })`); };
  choose("state.klass = 'vehicle'");
  assert.deepEqual(plain(heads()), ["1 found · 0 false · 0 missed, of the class vehicle", "1 found · 1 false · 0 missed, of the class vehicle"]);
  assert.notDeepEqual(strip(), all);
  assert.ok(page.byId("strip").textContent.includes("of the class vehicle"));
  assert.ok(added() < rows && page.byId("added").textContent.includes("of the class vehicle"), "no vehicle was added");
  choose("state.klass = ''; state.agent = 0");
  assert.deepEqual(plain(heads()), ["1 found · 0 missed, with points of cav1", "1 found · 0 missed, with points of cav1"]);
  assert.ok(page.byId("filters").textContent.includes("False boxes are not shown"));
  choose("state.agent = -1");
  assert.ok(!page.byId("filters").textContent.includes("False boxes"));
  assert.deepEqual(strip(), all);
  choose("state.hidden = new Set(['added', 'missed'])");
  assert.deepEqual(plain(heads()), ["1 found · 0 false", "1 found · 1 false"]);
});

test("the list of classes has those that are scored first, then the others with a word", () => {
  const of = scene();
  of.frames[2].objects.push([[2, 100, 100, 80, 400, 200, 160, 0, -1, 0], [3, 3]]);
  const page = open({ data: report({ scenes: [of], classes: ["pedestrian", "vehicle", "BicycleRider"] }) });
  assert.deepEqual(plain(page.value("classesIn(scene())")), [["vehicle", "vehicle"], ["pedestrian", "pedestrian"], ["BicycleRider", "BicycleRider (not scored)"]]);
});

test("tracks have the numbers of the log, and boxes that a run follows their own, with a trail", () => {
  const of = scene({ tracks: { 7: "18446744073709551615", 9: "4711" } });
  for (let seq = 0; seq < 10; seq++) of.runs[0].frames[seq].boxes[0] = [...of.runs[0].frames[seq].boxes[0], 9, 300, -400];
  const page = open({ data: report({ scenes: [of] }) });
  page.value("state.picked = { kind: 'object', run: 0, seq: 5, index: 0, track: 7 }");
  page.value("seek(5)");
  page.value("camera.scale = 8");
  const calls = (pane) => { page.value(`panes[${pane}].context.calls.length = 0`); page.value("draw()"); return plain(page.value(`panes[${pane}].context.calls`)); };
  for (const view of ["top", "3d"]) {
    page.value(`state.view = '${view}'`);
    const [followed, other] = [calls(0), calls(1)];
    assert.ok(followed.some(([name, text]) => name === "fillText" && text === "4711"), view);
    assert.ok(!other.some(([name, text]) => name === "fillText" && text === "4711"), view);
    // Of a trail of six sweeps five pieces more than without one, and one of the velocity.
    const pieces = (all) => all.filter(([name]) => name === "lineTo").length;
    const had = pieces(followed);
    page.value("(scene().runs[0].frames[5].boxes[0].length = 11, judgedSweeps.clear())");
    assert.equal(had - pieces(calls(0)), 6, view);
    page.value("(scene().runs[0].frames[5].boxes[0].push(9, 300, -400), judgedSweeps.clear())");
  }
  page.value("draw()");
  const story = page.byId("story").textContent;
  for (const words of ["track of the log18446744073709551615", "track of the run4711", "speed5.0 m/s"]) assert.ok(story.includes(words), story);
  assert.ok(page.byId("legend").textContent.includes("the run follows"));
  assert.ok(!opened().byId("legend").textContent.includes("the run follows"));
});

test("after a click on an object that was added Space plays", () => {
  const page = opened();
  const button = page.byId("added").all("button")[0];
  button.focus();
  button.dispatch("click");
  assert.equal(page.value("document.activeElement === panes[0].canvas"), true);
  page.press(" ", { target: { tagName: page.value("document.activeElement.tag").toUpperCase() } });
  assert.equal(page.value("state.playing"), true);
});

test("a click on an object of the list moves the view to it, unless it is in view", () => {
  const page = opened();
  const button = page.byId("added").all("button")[0];
  const before = plain(page.value("camera"));
  button.dispatch("click");
  assert.deepEqual(plain(page.value("camera")), before, "it is in view");
  page.value("camera.x += 500");
  button.dispatch("click");
  const at = page.value("(() => { const pane = panes.find((pane) => pickedIn(pane, judged(scene(), pane.run, seqNow()))); const sweep = judged(scene(), pane.run, seqNow()); const box = pickedIn(pane, sweep).box; return projection(pane.width, pane.height)(...inMap(sweep.pose, box[0], box[1], 0)).slice(0, 2).concat(pane.width / 2, pane.height / 2); })()");
  close(plain(at).slice(0, 2), plain(at).slice(2), 1e-6);
});

test("beside a run is the ego alone that it is compared with", () => {
  const of = scene();
  const runs = [run("late", { against: 2 }), run("other", { alone: true }), run("none", { alone: true })];
  const page = open({ data: report({ runs, scenes: [scene({ runs: [of.runs[0], of.runs[1], { ...of.runs[1], run: 2 }] })] }) });
  assert.deepEqual(plain(page.value("state.runs")), [0, 2]);
});
