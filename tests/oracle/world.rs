//! Random logs, links and settings, each from a seed.

use std::collections::BTreeMap;

use realo_schemas::Nanos;

/// A millisecond, ns.
pub const MS: Nanos = 1_000_000;
/// The agent whose view is fused.
pub const EGO: &str = "cav1";
/// Names before and after the ego's in the alphabet, because ties are decided by name.
const OTHERS: [&str; 5] = ["rsu1", "aux", "cav2", "zed", "cav3"];
const ORIGIN: Nanos = 1_700_000_000_000_000_000;

/// Where something is and whither it looks, in the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// In `map`, m.
    pub at: [f64; 2],
    /// Counter-clockwise from the x axis of `map`, rad.
    pub yaw: f64,
}

impl Spot {
    /// A point of this frame, in `map`.
    pub fn map_from_here(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw.sin_cos();
        [self.at[0] + cos * x - sin * y, self.at[1] + sin * x + cos * y]
    }

    /// A point of `map`, in this frame.
    pub fn here_from_map(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw.sin_cos();
        let (x, y) = (x - self.at[0], y - self.at[1]);
        [cos * x + sin * y, cos * y - sin * x]
    }
}

/// What an agent says: the boxes or points of a sweep, or where it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Said {
    /// Who.
    pub agent: String,
    /// Counts per agent, in order of stamps.
    pub seq: u64,
    /// When it was measured.
    pub stamp: Nanos,
    /// When the log has it.
    pub ready: Nanos,
    /// Where the agent was; a sweep's header may not say it.
    pub spot: Option<Spot>,
    /// How many boxes or points a sweep has.
    pub count: usize,
    /// Whether boxes have a track id below 2³² and a velocity.
    pub tracked: bool,
}

/// Where the content number `place` of any sweep lies in its agent's frame, m.
pub fn content(place: usize) -> [f64; 2] {
    // Far enough apart that no box suppresses another.
    [10.0 * place as f64, 0.0]
}

/// What a channel does to packets of a kind.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    pub fixed: Nanos,
    pub bits_per_second: Option<u64>,
    pub uniform_ms: f64,
    pub gaussian_ms: f64,
    pub loss: f64,
    pub duplicate: f64,
}

impl Channel {
    /// Its table of a profile.
    fn table(&self, name: &str) -> String {
        let Channel {
            fixed,
            bits_per_second,
            uniform_ms,
            gaussian_ms,
            loss,
            duplicate,
        } = *self;
        let fixed_ms = fixed as f64 / MS as f64;
        let rate = bits_per_second.map_or(String::new(), |rate| format!("bits_per_second = {rate}\n"));
        let jitter = format!("jitter = {{ uniform_ms = {uniform_ms:?}, gaussian_ms = {gaussian_ms:?} }}\n");
        format!("[{name}]\nfixed_ms = {fixed_ms:?}\nloss = {loss:?}\nduplicate = {duplicate:?}\n{rate}{jitter}")
    }
}

/// What crosses, and who brings it to the ego's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Strategy {
    /// Boxes; the receiver.
    Late,
    /// Points; the receiver.
    Early,
    /// Points; the sender, by the states of the ego that came to it over a link.
    Projected,
}

/// One log, and all settings of the graph.
#[derive(Clone, Debug)]
pub struct World {
    /// What crosses.
    pub strategy: Strategy,
    /// Whether the fusion of points leaves them where their sender put them.
    pub as_sent: bool,
    /// Whether it is played offline.
    pub offline: bool,
    /// The ego's and the others' sweeps, in any order.
    pub sweeps: Vec<Said>,
    /// Where agents were, in any order.
    pub states: Vec<Said>,
    /// The channel of sweeps.
    pub channel: Channel,
    /// The channel of states.
    pub state_channel: Channel,
    /// Seed of the channels' draws.
    pub channel_seed: u64,
    /// Reach of the channels, m.
    pub range_m: f64,
    /// Largest packet that is taken, bytes.
    pub max_bytes: usize,
    /// Largest age that the bank selects, ms.
    pub window_ms: u32,
    /// How long a query waits in the bank for a message that its sender's rhythm announces, ms.
    pub patience_ms: u32,
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
    /// Whether sweeps come so regularly that a bank may wait for them.
    rhythmic: bool,
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
            rhythmic: random.chance(25),
        };
        let strategy = random.pick(&[
            Strategy::Late,
            Strategy::Late,
            Strategy::Early,
            Strategy::Projected,
            Strategy::Projected,
        ]);
        let max_bytes = match strategy {
            Strategy::Late => random.pick(&[64 << 20, 64 << 20, 400, 250]),
            _ => random.pick(&[64 << 20, 64 << 20, 200, 150]),
        };
        // Sends so much while queries wait that the bank does not hold it all.
        let ends_early = random.chance(10);
        let range_m = random.pick(&[70.0, 70.0, 30.0, 1000.0, 1000.0]);
        let others = &OTHERS[..random.within(1, 5) as usize];
        let mut world = World {
            strategy,
            as_sent: strategy != Strategy::Late && random.chance(40),
            offline,
            sweeps: sweeps(random, EGO, style, false),
            states: states(random, EGO, style),
            channel: channel(random, style.grid),
            state_channel: channel(random, style.grid),
            channel_seed: random.next(),
            range_m: if ends_early { 1000.0 } else { range_m },
            max_bytes,
            window_ms: random.pick(&[400, 400, 400, 150, 0]),
            patience_ms: random.pick(&[0, 0, 0, 0, 0, 5, 30, 80, 200]),
            ahead_ms: random.pick(&[1000, 1000, 30, 0]),
            max_collaborators: random.pick(&[None, None, Some(1), Some(2), Some(0)]),
            compute: BTreeMap::new(),
        };
        if style.rhythmic {
            world.has_patience(random.pick(&[5, 30, 80, 200]));
        }
        if !offline {
            world.compute = match ends_early {
                true => [("bank.ego".to_string(), random.within(100, 400) * MS)].into(),
                false => compute(random, style.grid, &world.stages()),
            };
        }
        for (number, other) in others.iter().enumerate() {
            let ends_early = ends_early && number == 0;
            world.sweeps.extend(sweeps(random, other, style, ends_early));
            // An agent whose position is not known does not pass the gate.
            if random.chance(90) {
                world.states.extend(states(random, other, style));
            }
        }
        world
    }

    /// Without most of what keeps messages from a bank that waits for them.
    fn has_patience(&mut self, patience_ms: u32) {
        self.patience_ms = patience_ms;
        (self.range_m, self.max_bytes) = (1000.0, 64 << 20);
        (self.window_ms, self.ahead_ms) = (self.window_ms.max(150), 1000);
        (self.channel.bits_per_second, self.state_channel.bits_per_second) = (None, None);
    }

    /// The stages of the graph that take time.
    pub fn stages(&self) -> Vec<&'static str> {
        let detect = ["ego-nms", "nms"];
        let tell = ["ego-sender", "state-sender", "state-link", "state-receiver"];
        let share = ["encoder", "link", "decoder", "bank", "fusion"];
        match self.strategy {
            Strategy::Late => [&detect[..], &share[..]].concat(),
            Strategy::Early => share.to_vec(),
            Strategy::Projected => [&tell[..], &share[..]].concat(),
        }
    }

    /// The channels as a profile.
    pub fn profile(&self) -> String {
        self.channel.table("default") + &self.state_channel.table("kinds.agent_state")
    }

    /// What a call of a stage takes, ns.
    pub fn compute(&self, stage: &str) -> Nanos {
        self.compute.get(stage).copied().unwrap_or(0)
    }

    /// What a call of the bank takes, by what triggers it, ns.
    pub fn compute_of_bank(&self, trigger: &str) -> Nanos {
        let own = self.compute.get(&format!("bank.{trigger}")).copied();
        own.unwrap_or_else(|| self.compute("bank"))
    }
}

fn multiple(time: Nanos, grid: Nanos) -> Nanos {
    time.div_euclid(grid) * grid
}

fn sweeps(random: &mut Random, agent: &str, style: Style, ends_early: bool) -> Vec<Said> {
    let Style {
        offline,
        grid,
        duration,
        unposed,
        rhythmic,
    } = style;
    let period = match ends_early {
        true if offline => random.within(2 * MS, 3 * MS),
        true => random.within(5 * MS, 12 * MS),
        false => multiple(random.within(50 * MS, 250 * MS), grid),
    };
    let phase = multiple(random.within(0, period), grid);
    let late = multiple(random.pick(&[0, 40, 100, 300, -20]) * MS, grid);
    // More than a period puts sweeps out of order.
    let (scatter, jitter) = match rhythmic {
        true => (
            random.pick(&[0, 0, 0, period / 2, 2 * period]),
            random.pick(&[0, 0, period / 3]),
        ),
        false => (random.pick(&[0, 0, period / 2, 2 * period]), period / 3),
    };
    let missing = random.pick(&[0, 0, 10, 40]);
    let silence = random.within(0, duration);
    let silence = silence..silence + random.pick(&[0, 0, 300, 1000]) * MS;
    let mut sweeps: Vec<Said> = Vec::new();
    for tick in (phase..duration).step_by(period as usize) {
        let stamp = ORIGIN + multiple(tick + random.within(0, jitter), grid);
        let delay = late + multiple(random.within(0, scatter), grid);
        let sweep = Said {
            agent: agent.into(),
            seq: sweeps.len() as u64,
            stamp,
            ready: if offline { stamp } else { stamp + delay },
            spot: (!random.chance(unposed)).then(|| spot(random)),
            count: random.within(0, 12) as usize,
            tracked: random.chance(50),
        };
        if !random.chance(missing) && !silence.contains(&tick) {
            sweeps.push(sweep);
        }
    }
    sweeps
}

/// With mm and mrad.
fn spot(random: &mut Random) -> Spot {
    let mut thousandths = |most: i64| random.within(-most * 1000, most * 1000) as f64 / 1000.0;
    Spot {
        at: [thousandths(60), thousandths(60)],
        yaw: thousandths(3),
    }
}

/// An agent that passes the origin of `map` on a straight line, and turns.
fn states(random: &mut Random, agent: &str, style: Style) -> Vec<Said> {
    let period = multiple(random.within(30 * MS, 300 * MS), style.grid);
    let scatter = random.pick(&[0, 0, 2 * period]);
    let first = spot(random);
    let mut each_second = |most: i64| random.within(-most * 1000, most * 1000) as f64 / 1000.0;
    let ([vx, vy], turn) = ([each_second(30), each_second(30)], each_second(1));
    // Who reports its position late has its packets wait.
    let silent = if random.chance(20) {
        random.within(0, style.duration / 2)
    } else {
        0
    };
    let ticks = (0..style.duration)
        .step_by(period as usize)
        .filter(|tick| *tick >= silent)
        .zip(0..);
    ticks
        .map(|(tick, seq)| {
            let delay = multiple(random.within(0, scatter), style.grid);
            let seconds = tick as f64 * 1e-9;
            Said {
                agent: agent.into(),
                seq,
                stamp: ORIGIN + tick,
                ready: ORIGIN + tick + if style.offline { 0 } else { delay },
                spot: Some(Spot {
                    at: [first.at[0] + vx * seconds, first.at[1] + vy * seconds],
                    yaw: first.yaw + turn * seconds,
                }),
                count: 0,
                tracked: false,
            }
        })
        .collect()
}

fn channel(random: &mut Random, grid: Nanos) -> Channel {
    let fixed = random.pick(&[0, 0, 10 * MS, 41_700_000, 97 * MS, 300 * MS]);
    Channel {
        fixed: multiple(fixed, grid),
        bits_per_second: random.pick(&[None, None, None, Some(27_000_000), Some(40_000), Some(100)]),
        uniform_ms: random.pick(&[0.0, 0.0, 80.0]),
        gaussian_ms: random.pick(&[0.0, 0.0, 40.0]),
        loss: random.pick(&[0.0, 0.0, 0.1, 0.5]),
        duplicate: random.pick(&[0.0, 0.0, 0.1, 0.5]),
    }
}

fn compute(random: &mut Random, grid: Nanos, stages: &[&str]) -> BTreeMap<String, Nanos> {
    let mut nodes = BTreeMap::new();
    for stage in stages {
        let most = match *stage {
            // A link that cannot keep up makes its queue run over.
            "link" | "state-link" => 40,
            // Queries wait.
            "bank" => 70,
            _ => 220,
        };
        if random.chance(45) {
            nodes.insert(stage.to_string(), multiple(random.within(0, most * MS), grid));
        }
        if *stage == "bank" && random.chance(10) {
            nodes.insert("bank.wake".into(), multiple(random.within(0, most * MS), grid));
        }
    }
    nodes
}
