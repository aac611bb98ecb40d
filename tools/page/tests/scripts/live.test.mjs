// The page of a run that goes on: what comes over its socket.

import assert from "node:assert/strict";
import test from "node:test";

import { open } from "./browser.mjs";
import { box, object, report, scene } from "./documents.mjs";

const plain = (value) => JSON.parse(JSON.stringify(value));

function opened() {
  const page = open({ scripts: ["tools.js", "player.js", "live.js"], data: report({ runs: [], classes: [] }) });
  const [socket] = page.sockets;
  page.send = (data) => page.sockets.at(-1).hears.message({ data });
  page.say = (said) => page.send(JSON.stringify(said));
  socket.hears.open();
  return page;
}

const opening = () => ({
  what: "scene", run: { name: "late, log, cav1", alone: false, mode: "realtime" }, iou: "0.5", classes: ["vehicle"],
  scene: scene({ frames: {}, runs: [{ run: 0, recorded: 0, frames: {}, messages: [], carried: [] }] }),
});

/** A picture as the program writes it: bytes of the text, the text, steps of points. */
function picture(seq, clouds = []) {
  const points = clouds.flatMap(({ steps }) => steps);
  let first = 0;
  const index = clouds.map(({ agent, t, steps }) => {
    const part = { agent, t, from: [100, 0, 0], points: [first, steps.length] };
    first += steps.length;
    return part;
  });
  const head = {
    seq, start: "0", agents: [{ name: "cav1", roadside: false, footprint: null }, { name: "rsu1", roadside: true, footprint: null }], classes: ["vehicle"], clouds: index,
    frame: { t: 100 * seq, key: true, poses: [[100 * seq, 0, 0, 0], [2000, 0, 0, 0]], objects: [object(0, 10, 2, 7, [2, 9])] },
    run: { boxes: [box(0, 900, 10, 2, 0, 0)], known: true }, tracks: { 7: "41" },
  };
  let text = JSON.stringify(head);
  if (new TextEncoder().encode(text).length % 2) text += " ";
  const letters = new TextEncoder().encode(text);
  const buffer = new ArrayBuffer(4 + letters.length + 2 * points.length);
  const view = new DataView(buffer);
  view.setUint32(0, letters.length, true);
  new Uint8Array(buffer, 4).set(letters);
  points.forEach((step, at) => view.setInt16(4 + letters.length + 2 * at, step, true));
  return buffer;
}

test("pictures are shown as they come, with their points", () => {
  const page = opened();
  page.send(picture(0));
  assert.equal(page.value("live.pictures"), 0, "no run yet");
  page.say(opening());
  for (let seq = 0; seq < 5; seq++) page.send(picture(seq, [{ agent: "cav1", t: 100 * seq, steps: [50, 0, 0] }, { agent: "rsu1", t: 100 * seq, steps: [-50, 25, 0, 1, 2, 3] }]));
  assert.deepEqual(plain(page.value("[live.pictures, live.points, timeline(), state.at]")), [5, 15, [0, 1, 2, 3, 4], 4]);
  const points = [...page.value("pointsOf(cloudNear('log', 'rsu1', 300))")];
  [0, 0.5, 0, 1.02, 0.04, 0.06].forEach((metres, at) => assert.ok(Math.abs(points[at] - metres) < 1e-6, points.join()));
  assert.equal(page.value("trackName(scene(), 7)"), "41");
  page.send(picture(2));
  assert.equal(page.value("live.pictures"), 5, "what is older than the newest is not taken");
});

test("the same sweep of another agent's points is kept once", () => {
  const page = opened();
  page.say(opening());
  for (let seq = 0; seq < 3; seq++) page.send(picture(seq, [{ agent: "rsu1", t: 0, steps: [1, 2, 3] }]));
  assert.equal(page.value("DOC.points.length"), 1);
});

test("what was fused is known whether it is said before or after the picture", () => {
  const page = opened();
  page.say(opening());
  const agents = [{ name: "cav1" }, { name: "rsu1", roadside: true }];
  const used = (seq) => page.say({ what: "used", agents, used: { [seq]: [[1, 2, 934, seq]] } });
  page.send(picture(0));
  assert.equal(page.value("judged(scene(), 0, 0).boxes[0].fate"), "hit");
  used(0);
  assert.equal(page.value("judged(scene(), 0, 0).boxes[0].fate"), "added", "it is judged anew");
  used(0);
  assert.equal(page.value("judged(scene(), 0, 0).used.length"), 1, "once");
  used(1);
  page.send(picture(1));
  assert.equal(page.value("judged(scene(), 0, 1).boxes[0].fate"), "added");
  for (let seq = 10; seq < 5000; seq++) used(seq);
  assert.ok(page.value("live.used.size") <= 600, "what waits is bounded");
});

test("memory is bounded in a run of hours", () => {
  const page = opened();
  page.say(opening());
  for (let seq = 0; seq < 1000; seq++) {
    page.send(picture(seq, [{ agent: "cav1", t: 100 * seq, steps: [1, 2, 3] }]));
    page.wait(100);
  }
  const kept = page.value("[timeline().length, Object.keys(scene().frames).length, Object.keys(scene().runs[0].frames).length]");
  assert.deepEqual(plain(kept), [600, 600, 600]);
  assert.ok(page.value("DOC.points.length") <= 150 + 64 + 3, "points of few sweeps are kept");
  assert.ok(page.value("judgedSweeps.size") <= 2 * 600, String(page.value("judgedSweeps.size")));
  assert.ok(page.value("decoded.size") <= 64);
  assert.equal(page.value("seqNow()"), 999);
});

test("who looks at an earlier sweep stays there until it goes, and comes back by Live or the end of playing", () => {
  const page = opened();
  page.say(opening());
  for (let seq = 0; seq < 50; seq++) page.send(picture(seq));
  page.press("ArrowLeft");
  assert.deepEqual(plain(page.value("[live.shows, seqNow()]")), [false, 48]);
  for (let seq = 50; seq < 620; seq++) page.send(picture(seq));
  assert.equal(page.value("seqNow()"), 48, "though sweeps before it went");
  for (let seq = 620; seq < 700; seq++) page.send(picture(seq));
  assert.equal(page.value("seqNow()"), 100, "the oldest that is kept");
  page.press("End");
  assert.deepEqual(plain(page.value("[live.shows, seqNow()]")), [true, 699]);
  page.value("step(-3)");
  page.value("play(true)");
  page.play(400);
  assert.deepEqual(plain(page.value("[live.shows, state.playing, seqNow()]")), [true, false, 699]);
});

test("a new run takes the place of the one before, and a server that is gone is asked again", () => {
  const page = opened();
  page.say(opening());
  page.send(picture(3, [{ agent: "cav1", t: 300, steps: [1, 2, 3] }]));
  page.value("state.klass = 'vehicle'");
  page.sockets[0].hears.close();
  assert.ok(page.byId("what").textContent.includes("closed"));
  assert.equal(page.value("panes[0].shown.length > 0"), true, "what came stays");
  page.wait(1000);
  assert.equal(page.sockets.length, 2);
  assert.equal(page.sockets[1].url, "ws://127.0.0.1:8800/pictures");
  page.sockets[1].hears.open();
  page.say(opening());
  assert.deepEqual(plain(page.value("[timeline(), DOC.points, live.pictures, judgedSweeps.size, panes.length]")), [[], [], 0, 0, 0]);
  page.send(picture(0));
  assert.equal(page.value("state.at"), 0);
});

test("junk before the first run, and keys, disturb nobody", () => {
  const page = opened();
  page.press("End");
  page.press(" ");
  page.say({ what: "used", used: { 1: [[1, 2, 3, 4]] }, agents: [] });
  page.wait(5000);
  assert.ok(page.byId("what").textContent.includes("Waiting"));
});
