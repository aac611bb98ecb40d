//! Offsets of made streams: the truth is within the bound in at least 95 % of seeds.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use realo_schemas::{Nanos, from_seconds, to_millis, to_seconds};
use realo_time_offset::{
    ArrivalOffset, Handling, Heading, MotionLimits, NoMotionOffset, Offset, SensorClock, StampFault, YawRate,
    motion_offset,
};

const START: Nanos = 1_790_000_000_000_000_000;
const MS: Nanos = 1_000_000;

struct Draws(ChaCha8Rng);

impl Draws {
    fn new(seed: u64) -> Self {
        Draws(ChaCha8Rng::seed_from_u64(seed))
    }

    fn uniform(&mut self) -> f64 {
        ((self.0.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// Of mean 1, and density 0 at 0.
    fn gamma(&mut self) -> f64 {
        -0.5 * (self.uniform().ln() + self.uniform().ln())
    }
}

/// How many estimates hold the truth, and the bounds' mean, ms.
fn share(found: &[(Offset, Nanos)]) -> (f64, f64) {
    let held = found
        .iter()
        .filter(|(offset, truth)| (offset.offset - truth).abs() <= offset.bound);
    let bounds = found.iter().map(|(offset, _)| to_millis(offset.bound)).sum::<f64>();
    (held.count() as f64 / found.len() as f64, bounds / found.len() as f64)
}

/// Sweeps at 10 Hz for 60 s, whose clock is off and drifts, with delays above a least one that is known to 2 ms.
#[test]
fn arrivals_show_an_offset_within_its_bound() {
    for heavy in [false, true] {
        let found: Vec<(Offset, Nanos)> = (0..400)
            .map(|seed| {
                let mut draws = Draws::new(seed);
                let offset = from_seconds(0.3 * draws.normal());
                let drift = 50e-6 * draws.normal();
                let least = 55.0 + 2.0 * draws.uniform();
                let mut arrivals = ArrivalOffset::new([55 * MS, 57 * MS], from_seconds(60.0));
                let mut truth = 0;
                for number in 0..600 {
                    let measured = START + number * 100 * MS;
                    truth = offset + from_seconds(drift * to_seconds(measured - START));
                    let jitter = if heavy {
                        8.0 * draws.gamma()
                    } else {
                        -4.0 * draws.uniform().ln()
                    };
                    arrivals.take(measured - truth, measured + from_seconds(1e-3 * (least + jitter)));
                }
                (arrivals.offset().expect("an offset"), truth)
            })
            .collect();
        let (held, bound) = share(&found);
        println!("arrivals, heavy {heavy}: {held:.3} of 400 within, mean bound {bound:.2} ms");
        assert!(held >= 0.95 && bound < 12.0);
        for (offset, _) in &found {
            assert!(offset.drift.abs() < 400_000.0);
        }
    }
}

/// Yaw rate of a drive with curves: steps of curvature, smoothed.
fn drive(draws: &mut Draws, seconds: f64) -> Vec<f64> {
    let (mut rate, mut aim) = (0.0, 0.0);
    (0..(seconds * 1_000.0) as usize)
        .map(|step| {
            if step % 4_000 == 0 {
                aim = if draws.uniform() < 0.5 {
                    0.0
                } else {
                    0.25 * draws.normal()
                };
            }
            rate += (aim - rate) * 2e-3;
            rate
        })
        .collect()
}

struct Streams {
    rates: Vec<YawRate>,
    headings: Vec<Heading>,
}

/// An IMU at 100 Hz whose stamps need `offset` to be the scanner's, and headings at 10 Hz.
fn streams(draws: &mut Draws, seconds: f64, offset: Nanos, noise: [f64; 2]) -> Streams {
    let truth = drive(draws, seconds);
    let bias = 3e-3 * draws.normal();
    let mut yaw = 3.0;
    let (mut rates, mut headings) = (Vec::new(), Vec::new());
    for (step, rate) in truth.iter().enumerate() {
        let stamp = START + step as Nanos * MS;
        if step % 10 == 3 {
            rates.push(YawRate {
                stamp: stamp - offset,
                rate: rate + bias + noise[0] * draws.normal(),
            });
        }
        if step % 100 == 0 {
            let wrapped: f64 = yaw + noise[1] * draws.normal();
            headings.push(Heading {
                stamp,
                yaw: (wrapped + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI,
            });
        }
        let next = truth.get(step + 1).unwrap_or(rate);
        yaw += 0.5 * (rate + next) * 1e-3;
    }
    Streams { rates, headings }
}

/// A minute of drive; noise of a consumer's gyro and of a tactical one, headings of 0.1°.
#[test]
fn motion_shows_an_offset_within_five_milliseconds() {
    for (name, noise) in [("consumer", [2.4e-3, 1.7e-3]), ("tactical", [2e-4, 1.7e-3])] {
        let mut found = Vec::new();
        let mut without = 0;
        for seed in 0..300 {
            let mut draws = Draws::new(seed);
            let offset = from_seconds(0.15 * draws.normal().clamp(-2.5, 2.5));
            let streams = streams(&mut draws, 60.0, offset, noise);
            match motion_offset(&streams.rates, &streams.headings, &MotionLimits::default()) {
                Ok(estimate) => found.push((estimate, offset)),
                Err(NoMotionOffset::Straight { .. } | NoMotionOffset::Ambiguous(_)) => without += 1,
                Err(error) => panic!("seed {seed}: {error}"),
            }
        }
        let (held, bound) = share(&found);
        println!(
            "motion, {name}: {held:.3} of {} within, mean bound {bound:.2} ms; {without} without",
            found.len()
        );
        assert!(held >= 0.95 && bound <= 3.0 && without < 30, "{name}");
        assert!(found.iter().all(|(offset, _)| offset.bound <= 5 * MS));
    }
}

#[test]
fn a_straight_drive_says_so() {
    let mut draws = Draws::new(1);
    let mut streams = streams(&mut draws, 60.0, 0, [2e-4, 1.7e-3]);
    for rate in &mut streams.rates {
        rate.rate = 2e-4 * draws.normal();
    }
    for heading in &mut streams.headings {
        heading.yaw = 1.7e-3 * draws.normal();
    }
    let found = motion_offset(&streams.rates, &streams.headings, &MotionLimits::default());
    assert!(
        matches!(
            found,
            Err(NoMotionOffset::Straight { .. } | NoMotionOffset::Ambiguous(_))
        ),
        "{found:?}"
    );
    let few = motion_offset(&streams.rates, &streams.headings[..20], &MotionLimits::default());
    assert!(matches!(few, Err(NoMotionOffset::Few(_))), "{few:?}");
    streams.rates[7].rate = f64::NAN;
    let unsound = motion_offset(&streams.rates, &streams.headings, &MotionLimits::default());
    assert_eq!(unsound, Err(NoMotionOffset::Unsound("yaw rates")));
}

#[test]
fn an_offset_beyond_the_search_says_so() {
    let mut draws = Draws::new(2);
    let streams = streams(&mut draws, 60.0, from_seconds(0.8), [2e-4, 1.7e-3]);
    let found = motion_offset(&streams.rates, &streams.headings, &MotionLimits::default());
    assert!(found.is_err(), "{found:?}");
    let wide = MotionLimits {
        largest: from_seconds(1.5),
        ..MotionLimits::default()
    };
    let found = motion_offset(&streams.rates, &streams.headings, &wide).unwrap();
    assert!((found.offset - from_seconds(0.8)).abs() <= found.bound);
}

/// The clock of a sensor by TAI that steps by 1 s in mid-run: named, taken back, and the rest of the offset is estimated.
#[test]
fn a_sensors_clock_is_judged_as_a_whole() {
    let mut draws = Draws::new(3);
    let mut clock = SensorClock::new(Handling::Rebase, [10 * MS, 12 * MS], from_seconds(30.0));
    assert_eq!(clock.judged(), None);
    let mut errors = Vec::new();
    for number in 0..1_200i64 {
        let measured = START + number * 50 * MS;
        let off = 37_000 * MS + if number < 600 { 0 } else { 1_000 * MS };
        let arrival = measured + 11 * MS + from_seconds(-2e-3 * draws.uniform().ln());
        if let Some(stamp) = clock.take(measured + off, 0, arrival).stamp {
            errors.push((number, (stamp - measured).abs()));
        }
    }
    let faults = clock.faults();
    assert_eq!(faults.count(StampFault::Jump), 1);
    assert!(faults.count(StampFault::Tai) > 1_000);
    let judged = clock.judged().unwrap();
    let offset = judged.offset.unwrap();
    assert!((offset.offset + 38_000 * MS).abs() <= offset.bound, "{offset:?}");
    let last = errors.last().unwrap().1;
    assert!(last <= 10 * MS, "{last}");
    assert!(!judged.is_contradicted);
    clock.set_motion(Offset {
        offset: offset.offset + 40 * MS,
        bound: MS,
        ..offset
    });
    assert!(clock.judged().unwrap().is_contradicted);
}
