//! Random logs, links and settings, each from a seed.

use std::collections::BTreeMap;

use realo_link::{Jitter, Model};
use realo_schemas::Nanos;

/// A millisecond, ns.
pub const MS: Nanos = 1_000_000;
/// The agent whose view is fused.
pub const EGO: &str = "cav1";
/// The stages of the graph, in topological order.
pub const STAGES: [&str; 7] = ["ego-nms", "nms", "encoder", "link", "decoder", "bank", "fusion"];

/// Names before and after the ego's in the alphabet, because ties are decided by name.
const OTHERS: [&str; 5] = ["rsu1", "aux", "cav2", "zed", "cav3"];
const ORIGIN: Nanos = 1_700_000_000_000_000_000;

/// Detections of one sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Who measured.
    pub agent: String,
    /// Counts per agent, in order of stamps.
    pub seq: u64,
    /// When it was measured.
    pub stamp: Nanos,
    /// When the log has it.
    pub ready: Nanos,
    /// How many detections.
    pub boxes: usize,
    /// Whether the detections have a track id below 2³² and a velocity.
    pub tracked: bool,
    /// Whether the header has a pose.
    pub posed: bool,
}

/// Where an agent was.
#[derive(Clone, Debug, PartialEq)]
pub struct Fix {
    /// Who.
    pub agent: String,
    /// Counts per agent.
    pub seq: u64,
    /// When it was measured.
    pub stamp: Nanos,
    /// When the log has it.
    pub ready: Nanos,
    /// In `map`, m.
    pub at: [f64; 2],
}

/// One log, and everything that the graph is told.
#[derive(Clone, Debug)]
pub struct World {
    /// Whether it is played offline.
    pub offline: bool,
    /// The ego's and the others' sweeps, in any order.
    pub sweeps: Vec<Sweep>,
    /// The positions that are known, in any order.
    pub fixes: Vec<Fix>,
    /// The channel.
    pub channel: Model,
    /// Seed of the channel's draws.
    pub channel_seed: u64,
    /// Reach of the channel, m.
    pub range_m: f64,
    /// Greatest packet that is taken, bytes.
    pub max_bytes: usize,
    /// Greatest age that the bank selects, ms.
    pub window_ms: u32,
    /// How far a stamp may lie ahead of its arrival in the bank, ms.
    pub ahead_ms: u32,
    /// How many collaborators a fusion takes.
    pub max_collaborators: Option<usize>,
    /// Stage to ns per call.
    pub compute: BTreeMap<String, Nanos>,
}

/// SplitMix64 (Steele et al. 2014).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// In [low, high].
    fn within(&mut self, low: i64, high: i64) -> i64 {
        low + (self.next() % (high - low + 1) as u64) as i64
    }

    fn chance(&mut self, percent: i64) -> bool {
        self.within(0, 99) < percent
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.within(0, from.len() as i64 - 1) as usize]
    }
}

/// What the lanes of a world have in common.
#[derive(Clone, Copy)]
struct Style {
    offline: bool,
    /// All times are multiples of this; a coarse one makes ties.
    grid: Nanos,
    duration: Nanos,
    /// Percentage of sweeps without a pose.
    unposed: i64,
}

impl World {
    /// The world of a seed.
    pub fn of(seed: u64) -> World {
        let random = &mut Random(seed);
        let offline = random.chance(25);
        let style = Style {
            offline,
            grid: random.pick(&[1, 1, 5 * MS, 25 * MS]),
            duration: random.within(500, 3000) * MS,
            unposed: random.pick(&[0, 0, 0, 10]),
        };
        let others = &OTHERS[..random.within(1, 5) as usize];
        let mut world = World {
            offline,
            sweeps: sweeps(random, EGO, style),
            fixes: fixes(random, EGO, style),
            channel: channel(random, style.grid),
            channel_seed: random.next(),
            range_m: random.pick(&[70.0, 70.0, 30.0, 1000.0, 1000.0]),
            max_bytes: random.pick(&[64 << 20, 64 << 20, 400, 250]),
            window_ms: random.pick(&[400, 400, 400, 150, 0]),
            ahead_ms: random.pick(&[1000, 1000, 30, 0]),
            max_collaborators: random.pick(&[None, None, Some(1), Some(2), Some(0)]),
            compute: if offline {
                BTreeMap::new()
            } else {
                compute(random, style.grid)
            },
        };
        for other in others {
            world.sweeps.extend(sweeps(random, other, style));
            // An agent whose position is not known does not pass the gate.
            if random.chance(90) {
                world.fixes.extend(fixes(random, other, style));
            }
        }
        world
    }

    /// The channel as a profile.
    pub fn profile(&self) -> String {
        let Model {
            fixed_ms,
            bits_per_second,
            jitter,
            loss,
            duplicate,
        } = self.channel;
        let rate = bits_per_second.map_or(String::new(), |rate| format!("bits_per_second = {rate}\n"));
        let Jitter {
            uniform_ms,
            gaussian_ms,
        } = jitter;
        let jitter = format!("jitter = {{ uniform_ms = {uniform_ms:?}, gaussian_ms = {gaussian_ms:?} }}\n");
        format!("[default]\nfixed_ms = {fixed_ms:?}\nloss = {loss:?}\nduplicate = {duplicate:?}\n{rate}{jitter}")
    }
}

fn multiple(time: Nanos, grid: Nanos) -> Nanos {
    time.div_euclid(grid) * grid
}

fn sweeps(random: &mut Random, agent: &str, style: Style) -> Vec<Sweep> {
    let Style {
        offline,
        grid,
        duration,
        unposed,
    } = style;
    let period = multiple(random.within(50 * MS, 250 * MS), grid);
    let phase = multiple(random.within(0, period), grid);
    let late = multiple(random.pick(&[0, 40, 100, 300, -20]) * MS, grid);
    // More than a period puts sweeps out of order.
    let scatter = random.pick(&[0, 0, period / 2, 2 * period]);
    let missing = random.pick(&[0, 0, 10, 40]);
    let silence = random.within(0, duration);
    let silence = silence..silence + random.pick(&[0, 0, 300, 1000]) * MS;
    let mut sweeps: Vec<Sweep> = Vec::new();
    for tick in (phase..duration).step_by(period as usize) {
        let stamp = ORIGIN + multiple(tick + random.within(0, period / 3), grid);
        let delay = late + multiple(random.within(0, scatter), grid);
        let sweep = Sweep {
            agent: agent.into(),
            seq: sweeps.len() as u64,
            stamp,
            ready: if offline { stamp } else { stamp + delay },
            boxes: random.within(0, 12) as usize,
            tracked: random.chance(50),
            posed: !random.chance(unposed),
        };
        if !random.chance(missing) && !silence.contains(&tick) {
            sweeps.push(sweep);
        }
    }
    sweeps
}

/// An agent that passes the origin of `map` on a straight line.
fn fixes(random: &mut Random, agent: &str, style: Style) -> Vec<Fix> {
    let period = multiple(random.within(30 * MS, 300 * MS), style.grid);
    let scatter = random.pick(&[0, 0, 2 * period]);
    let mut metres = |most: i64| random.within(-most * 1000, most * 1000) as f64 / 1000.0;
    let ([x, y], [vx, vy]) = ([metres(60), metres(60)], [metres(30), metres(30)]);
    let ticks = (0..style.duration).step_by(period as usize).zip(0..);
    ticks
        .map(|(tick, seq)| {
            let delay = multiple(random.within(0, scatter), style.grid);
            let seconds = tick as f64 * 1e-9;
            Fix {
                agent: agent.into(),
                seq,
                stamp: ORIGIN + tick,
                ready: ORIGIN + tick + if style.offline { 0 } else { delay },
                at: [x + vx * seconds, y + vy * seconds],
            }
        })
        .collect()
}

fn channel(random: &mut Random, grid: Nanos) -> Model {
    let fixed = random.pick(&[0, 0, 10 * MS, 41_700_000, 97 * MS, 300 * MS]);
    Model {
        fixed_ms: multiple(fixed, grid) as f64 / MS as f64,
        bits_per_second: random.pick(&[None, None, None, Some(27_000_000), Some(40_000), Some(100)]),
        jitter: Jitter {
            uniform_ms: random.pick(&[0.0, 0.0, 80.0]),
            gaussian_ms: random.pick(&[0.0, 0.0, 40.0]),
        },
        loss: random.pick(&[0.0, 0.0, 0.1, 0.5]),
        duplicate: random.pick(&[0.0, 0.0, 0.1, 0.5]),
    }
}

fn compute(random: &mut Random, grid: Nanos) -> BTreeMap<String, Nanos> {
    let mut nodes = BTreeMap::new();
    for stage in STAGES {
        let most = match stage {
            // A link that cannot keep up makes its queue run over.
            "link" => 40,
            // Queries wait, but not so long that the bank holds no more of what they may ask for: 16 of each sender.
            "bank" => 70,
            _ => 220,
        };
        if random.chance(45) {
            nodes.insert(stage.to_string(), multiple(random.within(0, most * MS), grid));
        }
    }
    nodes
}
