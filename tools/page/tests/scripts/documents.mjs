// Documents as the page holds them, small.

const WORDS = { kinds: ["points", "features", "boxes", "agent_state"], fates: ["used", "skipped", "over_limit", "distrusted", "stale", "superseded", "lost", "rejected", "in_flight"] };

/** A box of a class by its number: at (x, y) m before the ego; further columns of its row. */
const row = (klass, x, y, ...more) => [klass, ...more, 100 * x, 100 * y, 80, 400, 200, 160, 0];
export const object = (klass, x, y, track, points, counts = 1) => [[...row(klass, x, y), track, counts], points];
/** What became of a box at IoU 0.3 and 0.5: the place of an object, -1 false, -2 not counted. */
export const box = (klass, score, x, y, ...became) => [...row(klass, x, y, score), ...became];

const result = (more = {}) => ({
  mode: "virtual", logs: ["log"], egos: ["cav1"], agents: ["cav1", "rsu1"], ego: "cav1", protocol: "default", links: {}, notes: [],
  frames: { key: 10, key_skipped: 0, total: 10, processed: 10 }, ...more,
});

export const run = (name, more = {}) => ({
  name, alone: false, fields: {}, result: result(more.result), timing: { latency: {}, waiting: {}, joining: {} }, quantiles: {}, ages: [], curves: {}, graph: {},
  ...Object.fromEntries(Object.entries(more).filter(([key]) => key !== "result")),
});

/** Scores of a run whose mean is this. */
export const scores = (mean) => ({ accuracy: { sorted: { mAP: { "0.5": mean }, AP: { vehicle: { "0.5": mean } }, counts: {} } } });

export function report(more = {}) {
  return {
    version: 1, program: "realo", verdict: [], iou: "0.5", differences: [], runs: [run("late", { against: 1 }), run("none", { alone: true })], classes: ["vehicle", "pedestrian"],
    scenes: [], points: [], left_out: [], words: WORDS, ...more,
  };
}

/**
 * A scene of ten sweeps, 100 ms apart, whose ego goes 1 m a sweep along y. There are a vehicle near the ego, which both runs find, and a
 * pedestrian without a point of the ego, which late fusion finds from sweep 3 on; the ego alone has a false box in sweep 5.
 */
export function scene(more = {}) {
  const frames = {}, late = {}, none = {};
  for (let seq = 0; seq < 10; seq++) {
    const objects = [object(0, 10, 2, 7, [40, 3]), object(1, 30, -5, 8, [0, 12])];
    frames[seq] = { t: 100 * seq, key: true, poses: [[0, 100 * seq, 0, 1571], [2000, 0, 0, 0]], objects };
    const near = box(0, 900, 10, 2, 0, 0);
    late[seq] = { boxes: seq < 3 ? [near] : [near, box(1, 600, 30, -5, 1, 1)], known: true, used: [[1, 2, 934, seq]] };
    none[seq] = { boxes: seq === 5 ? [near, box(0, 400, 50, 0, -1, -1)] : [near], known: true };
  }
  const of = (number, own) => ({ run: number, recorded: 10, frames: own, messages: [], carried: [] });
  return {
    log: "log", ego: "cav1", start: "0", agents: [{ name: "cav1", roadside: false, footprint: [-100, 350, -90, 90] }, { name: "rsu1", roadside: true, footprint: null }],
    region: [-10000, 10000, -4000, 4000], protocol: "default", scored: ["vehicle", "pedestrian"], tracks: {}, ious: ["0.3", "0.5"], seen_points: 10, frames, runs: [of(0, late), of(1, none)], ...more,
  };
}
