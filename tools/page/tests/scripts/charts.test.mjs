// Numbers as words, charts, and the tables of the page.

import assert from "node:assert/strict";
import test from "node:test";

import { open } from "./browser.mjs";
import { report, run, scene, scores } from "./documents.mjs";

const plain = (value) => JSON.parse(JSON.stringify(value));
const page = open({ data: report({ scenes: [scene()] }) });
const numbers = (text) => [...text.matchAll(/-?\d+(?:\.\d+)?/g)].map(([number]) => Number(number));
const paths = (drawing) => drawing.all("path").map((path) => path.getAttribute("d"));

test("numbers are written as a reader expects them", () => {
  for (const [expression, words] of [
    ["count(1234567)", "1,234,567"], ["count(999.6)", "1,000"], ["count(-1234)", "-1,234"], ["count(null)", "–"], ["count(0)", "0"],
    ["ms(0)", "0 ms"], ["ms(0.04)", "0.0 ms"], ["ms(-0.04)", "0.0 ms"], ["ms(9.94)", "9.9 ms"], ["ms(-12.6)", "−13 ms"], ["ms(undefined)", "–"],
    ["signed(0.0104)", "+0.010"], ["signed(-0.25)", "−0.250"], ["signed(-0.0004)", "0.000"], ["signed(0)", "0.000"], ["signed(null)", "–"],
    ["fixed(0.12345)", "0.123"], ["plural(1, 'sweep')", "1 sweep"], ["plural(1200, 'sweep')", "1,200 sweeps"],
  ]) assert.equal(page.value(expression), words, expression);
});

test("a quantile is a value of the list that so many do not exceed", () => {
  for (const [share, value] of [[0, 1], [0.25, 1], [0.26, 2], [0.5, 2], [1, 4]]) assert.equal(page.value(`quantile([4, 1, 3, 2], ${share})`), value);
  assert.equal(page.value("quantile([], 0.5)"), null);
});

test("ticks are round numbers within their ends", () => {
  assert.deepEqual(plain(page.value("ticks(0, 1)")), [0, 0.2, 0.4, 0.6, 0.8, 1]);
  assert.deepEqual(plain(page.value("ticks(-3, 41)")), [0, 10, 20, 30, 40]);
  assert.deepEqual(plain(page.value("ticks(0, 3e6)")), [0, 1e6, 2e6, 3e6]);
  for (const [low, high] of [[5, 5], [0, 1e-7], [-1e9, 1e9]]) {
    const all = plain(page.value(`ticks(${low}, ${high})`));
    assert.ok(all.length <= 12 && all.every((value) => value >= low - 1e-9 && value <= high * 1.0001 + 1e-12), `${low} ${high}: ${all}`);
  }
});

test("lines stay in their frame, whatever the values", () => {
  for (const points of [[[0, 0]], [[5, 7], [5, 7]], [[0, -3], [10, 1e6]], [[1e9, 0.5], [2e9, 0.5]]]) {
    const drawing = page.value(`lines([{ name: "a", color: "x", dash: "", points: ${JSON.stringify(points)}, dots: true }], { label: "s" }, { label: "", from: 0 })`);
    const [path] = paths(drawing);
    const found = numbers(path);
    assert.equal(found.length, 2 * points.length, path);
    found.forEach((pixel, at) => assert.ok(pixel >= 0 && pixel <= [380, 226][at % 2], path));
  }
  assert.equal(page.value("lines([{ points: [] }], { label: '' }, { label: '' })"), null);
});

test("lines end where sweeps without a value are between", () => {
  const points = [0, 1, 2, 3, 8, 9, 20].map((x) => [x, 1]);
  const drawing = page.value(`gapped([{ name: "a", color: "x", dash: "", points: ${JSON.stringify(points)} }], { label: "s" }, { label: "", low: 0, high: 2 })`);
  assert.deepEqual(paths(drawing).map((path) => numbers(path).length / 2), [4, 2, 1]);
  assert.equal(drawing.all("circle").length, 1, "a single one is a dot");
});

test("a flow's ribbons are as high as what they say, at both ends", () => {
  const drawing = page.value('ribbons([["a", [60, 40, 0]], ["b", [0, 1, 899]]], [["used", 0, "x"], ["lost", 1, "y"], ["late", 2, "z"]])');
  const ribbon = (path) => numbers(path);
  const all = paths(drawing);
  assert.equal(all.length, 4, "none of nothing");
  assert.ok(all.every((path) => !path.includes("NaN")));
  const tall = all.map((path) => { const at = ribbon(path); return [at[8] - at[7], at.at(-1) - at[1]]; });
  tall.forEach(([right, left]) => assert.ok(Math.abs(right - left) < 1e-6, `${right} ${left}`));
  const scale = tall[3][0] / 899;
  [60, 40, 1].forEach((value, at) => assert.ok(Math.abs(tall[at][0] - value * scale) < 1e-6));
  assert.equal(drawing.getAttribute("aria-label"), "Of 1,000 messages: 60 used, 41 lost, 899 late");
});

test("bins of all classes are summed, and a class has its own", () => {
  const table = { vehicle: { "0.5": [{ from: 0, to: 20, true: 3, false: 1, total: 4 }] }, pedestrian: { "0.5": [{ from: 0, to: 20, true: 1, total: 6 }] } };
  page.value("(asked.klass = '', asked.iou = '0.5')");
  const of = (klass) => { page.value(`asked.klass = '${klass}'`); return plain(page.value(`binsOf(${JSON.stringify(table)})`)); };
  assert.deepEqual(of(""), [{ from: 0, to: 20, true: 4, false: 1, total: 10 }]);
  assert.deepEqual(of("pedestrian"), [{ from: 0, to: 20, true: 1, false: 0, total: 6 }]);
  assert.deepEqual(of("truck"), []);
  of("");
});

test("a second in which nothing was sent is one of nothing", () => {
  const of = scene();
  of.runs[0].carried = [0, 1, 2, 5, 6].flatMap((second) => [[1, 1000 * second, 10, 2000], [0, 1000 * second, 5, 1000]]);
  const with_cut = open({ data: report({ scenes: [of] }) });
  const [path] = paths(with_cut.value("bytesOverTime()"));
  const heights = numbers(path).filter((_, at) => at % 2);
  assert.equal(heights.length, 5, "the first and the last are not whole");
  assert.deepEqual(heights.map((y) => y === Math.max(...heights)), [false, false, true, true, false]);
});

test("the score of a run whose classes lack objects is the mean of the others", () => {
  const of = (accuracy) => page.value(`meanOf(${JSON.stringify({ result: { accuracy } })}, "0.5")`);
  assert.equal(of({ sorted: { mAP: { "0.5": 0.7 }, AP: {} } }), 0.7);
  assert.equal(of({ sorted: { mAP: { "0.5": null }, AP: { vehicle: { "0.5": 0.6 }, truck: { "0.5": null }, pedestrian: { "0.5": 0.2 } } } }), 0.4);
  assert.equal(of(undefined), null);
});

test("objects that cooperation added are named, those it harmed too", () => {
  const of = scene();
  of.runs[0].frames[8].boxes = [];
  const added = open({ data: report({ scenes: [of] }) }).byId("added");
  const rows = added.all("tr").map((one) => one.nodes.map((cell) => cell.textContent));
  assert.deepEqual(rows[1].slice(0, 5), ["pedestrian 8", "10", "0", "6", "0"]);
  assert.deepEqual(rows[3].slice(0, 5), ["vehicle 7", "10", "10", "9", "40"]);
  assert.equal(open({ data: report({ runs: [run("late")], scenes: [scene({ runs: [scene().runs[0]] })] }) }).byId("added").hidden, true, "without the ego alone there is nothing to compare");
});

test("objects of two runs that fuse are compared too, and whoever has points on them is named", () => {
  const of = scene();
  const rows = (page) => page.byId("added").all("tr").map((one) => one.nodes.map((cell) => cell.textContent));
  // Without the ego alone the first is compared with the second, and the page says that there is no margin.
  const two = { runs: [run("cut"), run("whole")], scenes: [scene({ runs: [{ ...of.runs[1], run: 0 }, { ...of.runs[0], run: 1 }] })] };
  const cut = open({ data: report(two) });
  assert.equal(cut.byId("added").hidden, false);
  assert.ok(cut.byId("added").textContent.startsWith("What differs from whole"), cut.byId("added").textContent);
  assert.deepEqual(rows(cut), [["object", "sweeps", "found by whole", "found by cut", "own points, median", "most points of others, median"], ["pedestrian 8", "10", "7", "0", "0", "rsu1 12"]]);
  assert.ok("open" in cut.byId("added").all("details")[0].attributes, "what was lost is open where nothing was gained");
  assert.ok(cut.byId("table").textContent.includes("No run here is of the ego alone, so there is no margin"), cut.byId("table").textContent);
  // With the ego alone that is what is asked first; another run can be chosen.
  const runs = [run("attfuse", { against: 2 }), run("late", { against: 2 }), run("none", { alone: true })];
  const three = open({ data: report({ runs, scenes: [scene({ runs: [{ ...of.runs[1], run: 0 }, { ...of.runs[0], run: 1 }, { ...of.runs[1], run: 2 }] })] }) });
  assert.ok(three.byId("added").textContent.startsWith("What cooperation added") && !three.byId("table").textContent.includes("No run here"));
  const [choice] = three.byId("added").all("select");
  assert.deepEqual(choice.all("option").map((option) => option.textContent), ["the ego alone", "attfuse", "late"]);
  Object.defineProperty(choice, "selectedIndex", { value: 2 });
  choice.dispatch("change");
  assert.ok(three.byId("added").textContent.startsWith("What differs from late"), three.byId("added").textContent);
  assert.deepEqual(rows(three).filter(([name]) => name === "pedestrian 8").map((row) => row.slice(1, 4)), [["10", "7", "0"], ["10", "7", "0"]], "attfuse and none");
});

test("a bar of a few parts is written out, and a chart says what it is of", () => {
  const few = page.value('stacks([{ name: "late", parts: [["found", 3, "x"], ["missed", 1, "y"], ["false", 0, "z"]] }], "objects", true)');
  assert.deepEqual(few.all("small").map((words) => words.textContent), ["found 3 (75.0 %) · missed 1 (25.0 %)"]);
  const many = page.value('stacks([{ name: "late", parts: Array.from({ length: 6 }, (_, at) => [`part ${at}`, 2, "x"]) }], "ms", false)');
  assert.deepEqual(many.all("small"), []);
  const [recall] = page.byId("grid").all("svg").map((drawing) => drawing.getAttribute("aria-label")).filter((label) => label.includes("own points") || label.includes("How far"));
  assert.ok(/^(Recall by own points|How far boxes are off): /.test(recall), recall);
});

test("why objects were missed, and how far boxes are off, is counted", () => {
  const of = scene();
  // Half a metre off, which is enough at IoU 0.3 alone; and one of a low score.
  of.runs[0].frames[4].boxes = [[0, 900, 1040, 230, 80, 400, 200, 160, 0, 0, -1], [1, 250, 3000, -500, 80, 400, 200, 160, 0, 1, 1]];
  const cut = open({ data: report({ scenes: [of] }) });
  cut.value("(asked.klass = '', asked.iou = '0.5')");
  const parts = (name) => cut.value(`missedChart("")`).all("i").map((part) => part.getAttribute("title")).filter(Boolean).slice(...name);
  assert.deepEqual(parts([0, 4]), ["found: 15 objects", "a box is there, but its IoU is too small: 1 objects", "its box has a lower score: 1 objects", "no box is there: 3 objects"]);
  assert.equal(cut.value("whyMissed(judged(scene(), 0, 4, 1).objects[0])"), "a box is there, but its IoU is too small: its centre is off by 0.50 m");
  const [path] = paths(cut.value('offsetChart("")'));
  assert.ok(!path.includes("NaN") && numbers(path).length === 2 * 99, path);
});

test("where nothing of others came is listed with what it cost", () => {
  const of = scene();
  for (let seq = 10; seq < 60; seq++) {
    of.frames[seq] = { ...of.frames[9], t: 100 * seq };
    of.runs[0].frames[seq] = { ...of.runs[0].frames[9] };
    of.runs[1].frames[seq] = { ...of.runs[1].frames[9] };
  }
  for (let seq = 20; seq < 40; seq++) of.runs[0].frames[seq] = { boxes: of.runs[0].frames[seq].boxes.slice(0, 1), known: true };
  delete of.runs[0].frames[50].used;
  const cut = open({ data: report({ scenes: [of] }) });
  const rows = cut.value("silenceTable()").all("tr").map((row) => row.nodes.map((cell) => cell.textContent));
  assert.deepEqual(rows.slice(1), [["late", "2.0 to 3.9 s", "0.500 (20 of 40)", "0.963 (77 of 80)", "–", "0.500 (20 of 40)"]]);
  assert.equal(open({ data: report({ scenes: [scene()] }) }).value("silenceTable()"), null);
});

test("a graph is its picture, with what each stage runs and is set to", () => {
  const stages = { player: { runs: "player", "settings.rate": "1" }, fuse: { "settings.iou": "0.15", "settings.by": "<i>", "inputs.in": "player/clouds" } };
  const of = (more) => page.value(`graph(${JSON.stringify({ name: "late", graph: stages, ...more })})`);
  const drawing = of({ picture: "<svg>&#39;</svg>" });
  const [image] = drawing.all("img");
  assert.equal(image.getAttribute("src"), "data:image/svg+xml;charset=utf-8,%3Csvg%3E%26%2339%3B%3C%2Fsvg%3E");
  assert.equal(image.getAttribute("alt"), "Graph of late");
  const rows = drawing.all("tr").map((row) => row.nodes.map((cell) => cell.textContent));
  assert.deepEqual(rows.slice(1), [["player", "player", "rate=1"], ["fuse", "–", "iou=0.15 by=<i>"]]);
  const without = of({});
  assert.deepEqual([without.all("img").length, without.all("tr").length], [0, 3]);
});

test("a page of a hundred runs, and of a run that nobody scored, draws itself", () => {
  const many = Array.from({ length: 100 }, (_, at) => run(`run ${at}`, { alone: at === 7 }));
  const of = open({ data: report({ runs: many, scenes: [scene()] }) });
  assert.equal(of.byId("scoreboard").all("div").length, 12);
  assert.ok(of.byId("title").textContent.includes("97 more"));
  assert.ok(new Set(Array.from({ length: 36 }, (_, at) => of.value(`runColor(${at}) + runDash(${at})`))).size === 36, "colour and dash together differ");
});

const rowsOf = (table) => table.all("tr").map((row) => row.nodes.map((cell) => cell.textContent));

test("a margin is one over the ego alone of the run's own logs, or none with its reason", () => {
  const of = (name, mean, more) => run(name, { result: scores(mean), ...more });
  const runs = [of("late a", 0.7, { against: 3 }), of("late b", 0.5, { against: 2 }), of("none b", 0.4, { alone: true }), of("none a", 0.8, { alone: true }), of("late c", 0.6, { no_margin: "logs" })];
  const all = rowsOf(open({ data: report({ runs }) }).byId("table"));
  assert.deepEqual(all.find(([name]) => name === "margin over the ego alone").slice(1), ["−0.100over none a", "+0.100over none b", "–", "–", "–no run of the ego alone has the same logs"]);
  const two = rowsOf(open({ data: report({ runs: [of("late", 0.7, { against: 1 }), of("none", 0.8, { alone: true })] }) }).byId("table"));
  assert.deepEqual(two.find(([name]) => name === "margin over the ego alone").slice(1), ["−0.100", "–"]);
  const apart = rowsOf(open({ data: report({ runs: [of("late", 0.7, { no_margin: "protocol" }), of("none", 0.8, { alone: true })] }) }).byId("table"));
  assert.equal(apart.find(([name]) => name === "margin over the ego alone")[1], "–no run of the ego alone has the same protocol");
});

test("what cooperation added is asked of the ego alone that a run is compared with", () => {
  const of = scene();
  // Another run of the ego alone, which comes first and finds everything.
  const blind = { ...of.runs[0], run: 2 };
  const runs = [run("late", { against: 1 }), run("none", { alone: true }), run("other", { alone: true })];
  const rows = rowsOf(open({ data: report({ runs, scenes: [scene({ runs: [of.runs[0], blind, of.runs[1]] })] }) }).byId("added"));
  assert.deepEqual(rows[1].slice(0, 4), ["pedestrian 8", "10", "0", "7"]);
});

test("the best runs have cards, in their order, and one that was ended says so", () => {
  const runs = Array.from({ length: 14 }, (_, at) => run(`r${at}`, { result: { ...scores(at / 20), ...(at === 13 ? { ended_by: "Ctrl-C" } : {}) } }));
  const of = open({ data: report({ runs }) });
  const cards = of.byId("scoreboard").all("div").map((card) => card.textContent);
  assert.equal(cards.length, 12);
  assert.ok(cards[0].startsWith("r13") && cards[11].startsWith("r2"), cards.join());
  assert.ok(cards[0].includes("ended by Ctrl-C, after 10 scored sweeps") && !cards[1].includes("ended"), cards[0]);
  assert.ok(of.byId("scoreboard").textContent.includes("The 12 best of 14 runs"));
  assert.ok(of.byId("what").textContent.includes("1 run ended before the log was"));
  const one = open({ data: report({ runs: [run("late", { result: { ended_by: "Ctrl-C" } })] }) });
  assert.ok(one.byId("what").textContent.includes("ended by Ctrl-C before the log was"));
});

test("ages are drawn as the spans that they are in", () => {
  const of = scene();
  for (let seq = 0; seq < 10; seq++) {
    of.frames[seq].objects.push(...Array.from({ length: 9 }, (_, at) => [[1, 3000, 100 * at, 80, 400, 200, 160, 0, 20 + at, 1], [0, 9]]));
    of.runs[0].frames[seq].used = [[1, 2, seq < 5 ? 1496 : 2610, seq]];
  }
  const drawn = open({ data: report({ scenes: [of] }) }).value('ageChart("all classes")');
  const texts = drawn.all("text").map((text) => text.textContent);
  for (const words of ["100–150", "150–200", "200–250", "250–300"]) assert.ok(texts.includes(words), texts.join());
  assert.ok(!texts.some((text) => text.includes("125")), texts.join());
  assert.deepEqual(drawn.all("circle").map((dot) => dot.all("title")[0].textContent), ["late: 2 of 50, 100–150 ms", "late: 5 of 50, 250–300 ms"]);
  // One span alone is one name.
  for (let seq = 0; seq < 10; seq++) of.runs[0].frames[seq].used = [[1, 2, 1496, seq]];
  const one = open({ data: report({ scenes: [of] }) }).value('ageChart("all classes")').all("text").map((text) => text.textContent);
  assert.deepEqual(one.filter((text) => text.includes("–")), ["100–150"]);
  // A wide spread has few spans.
  of.runs[0].frames[9].used = [[1, 2, 90000, 9]];
  const wide = open({ data: report({ scenes: [of] }) }).value('ageChart("all classes")').all("text").map((text) => text.textContent);
  assert.ok(wide.filter((text) => text.includes("–")).length <= 8, wide.join());
});

test("each of many stages has a fill of its own, and its number on its bars", () => {
  assert.equal(new Set(Array.from({ length: 30 }, (_, at) => page.value(`fill(${at})`))).size, 30);
  const stages = Object.fromEntries(Array.from({ length: 8 }, (_, at) => [`stage ${at}`, { p50: 5 }]));
  const busy = open({ data: report({ runs: [run("late", { result: { mode: "realtime", isa: "avx2" }, timing: { latency: stages, waiting: {}, joining: stages, machine: "A CPU, 2 threads" } })] }) });
  const drawn = busy.value("stageFigure()");
  assert.deepEqual(drawn.all("i").filter((part) => part.getAttribute("title")).map((part) => part.textContent).filter((_, at) => at % 2), ["1", "2", "3", "4", "5", "6", "7", "8"]);
  assert.ok(drawn.textContent.includes("8 stage 7") && drawn.textContent.includes("those of A CPU, 2 threads; kernels of the networks: avx2"), drawn.textContent);
});
