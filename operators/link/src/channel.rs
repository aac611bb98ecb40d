//! What a channel does to one packet.

use realo_operator::Draws;
use realo_schemas::Nanos;

use crate::{Jitter, Model};

const LOSS: u64 = 0;
const DUPLICATE: u64 = 1;
const JITTER: u64 = 16;
const NANOS_PER_MILLI: f64 = 1e6;

/// Delays of the copies of a packet that arrive, ns, each at least 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrivals {
    /// The packet; `None` if it is lost.
    pub first: Option<Nanos>,
    /// One more copy.
    pub second: Option<Nanos>,
}

/// What becomes of a packet of so many bytes; a lost one has no copy either.
pub fn transmit(model: &Model, bytes: usize, draws: Draws) -> Arrivals {
    if draws.uniform(LOSS) < model.loss {
        return Arrivals {
            first: None,
            second: None,
        };
    }
    let delay_of = |copy: u64| {
        let index = JITTER + 4 * copy;
        delay(model, bytes, draws.uniform(index), draws.gaussian(index + 1))
    };
    let second = (draws.uniform(DUPLICATE) < model.duplicate).then(|| delay_of(1));
    Arrivals {
        first: Some(delay_of(0)),
        second,
    }
}

/// Delay of a packet of so many bytes, ns, at least 0: exact but for the draws of its jitter, one from [0, 1) and one from
/// N(0, 1).
pub fn delay(model: &Model, bytes: usize, uniform: f64, gaussian: f64) -> Nanos {
    let Jitter {
        uniform_ms,
        gaussian_ms,
    } = model.jitter;
    let jitter_ms = uniform_ms * (2.0 * uniform - 1.0) + gaussian_ms * gaussian;
    let nanos = |ms: f64| libm::round(ms * NANOS_PER_MILLI) as Nanos;
    let all = (nanos(model.fixed_ms) + crossing(model, bytes)).saturating_add(nanos(jitter_ms));
    match nanos(model.step_ms) {
        0 => all.max(0),
        step => all.max(0) / step * step,
    }
}

/// Time in which the bytes cross, ns, to the nearest; at most a day.
fn crossing(model: &Model, bytes: usize) -> Nanos {
    const DAY: u128 = 86_400_000_000_000;
    let Some(rate) = model.bits_per_second.filter(|rate| *rate > 0) else {
        return 0;
    };
    let (bits, rate) = (bytes as u128 * 8_000_000_000, u128::from(rate));
    ((bits + rate / 2) / rate).min(DAY) as Nanos
}

#[cfg(test)]
mod tests {
    use realo_operator::StreamKey;
    use realo_schemas::Kind;

    use super::*;

    fn draws(seq: u64) -> Draws {
        StreamKey::new(1, "link").draws("a", "b", Kind::Boxes, seq)
    }

    fn uniform(uniform_ms: f64) -> Jitter {
        Jitter {
            uniform_ms,
            ..Jitter::default()
        }
    }

    #[test]
    fn delays_are_exact() {
        let constant = Model {
            fixed_ms: 41.7,
            ..Model::default()
        };
        assert_eq!(
            transmit(&constant, 840_000, draws(0)),
            Arrivals {
                first: Some(41_700_000),
                second: None
            }
        );
        let affine = Model {
            fixed_ms: 0.3,
            bits_per_second: Some(27_000_000),
            ..Model::default()
        };
        assert_eq!(transmit(&affine, 3630, draws(0)).first, Some(300_000 + 1_075_556));
        assert_eq!(transmit(&affine, 0, draws(0)).first, Some(300_000));
        let slow = Model {
            bits_per_second: Some(1),
            ..Model::default()
        };
        assert_eq!(transmit(&slow, usize::MAX, draws(0)).first, Some(86_400_000_000_000));
    }

    #[test]
    fn delays_are_cut_down_to_whole_steps() {
        let of = |fixed_ms: f64| {
            let model = Model {
                fixed_ms,
                step_ms: 100.0,
                ..Model::default()
            };
            transmit(&model, 1000, draws(0)).first.unwrap() / 1_000_000
        };
        assert_eq!([0.0, 99.9, 100.0, 199.9, 350.0].map(of), [0, 0, 100, 100, 300]);
    }

    #[test]
    fn jitter_stays_in_its_bounds_and_never_delays_below_zero() {
        let uniform = Model {
            fixed_ms: 10.0,
            jitter: uniform(4.0),
            ..Model::default()
        };
        let delays: Vec<Nanos> = (0..2000)
            .filter_map(|seq| transmit(&uniform, 0, draws(seq)).first)
            .collect();
        assert!(delays.iter().all(|d| (6_000_000..=14_000_000).contains(d)));
        assert!(delays.iter().any(|d| *d < 6_200_000) && delays.iter().any(|d| *d > 13_800_000));
        let gaussian = Model {
            fixed_ms: 1.0,
            jitter: Jitter {
                gaussian_ms: 2.0,
                ..Jitter::default()
            },
            ..Model::default()
        };
        let delays: Vec<Nanos> = (0..2000)
            .filter_map(|seq| transmit(&gaussian, 0, draws(seq)).first)
            .collect();
        let at_once = delays.iter().filter(|d| **d == 0).count() as f64 / 2000.0;
        assert!(
            (at_once - 0.3085).abs() < 0.04,
            "the share of N(1, 2) below 0: {at_once}"
        );
    }

    #[test]
    fn loses_and_copies_as_often_as_it_says() {
        let model = Model {
            loss: 0.2,
            duplicate: 0.1,
            jitter: uniform(5.0),
            ..Model::default()
        };
        let arrivals: Vec<Arrivals> = (0..5000).map(|seq| transmit(&model, 10, draws(seq))).collect();
        let share = |count: usize| count as f64 / 5000.0;
        let lost = share(arrivals.iter().filter(|a| a.first.is_none()).count());
        let copied = share(arrivals.iter().filter(|a| a.second.is_some()).count());
        assert!(
            (lost - 0.2).abs() < 0.02 && (copied - 0.08).abs() < 0.015,
            "{lost} {copied}"
        );
        assert!(arrivals.iter().all(|a| a.first.is_some() || a.second.is_none()));
        assert!(
            arrivals.iter().any(|a| a.second.is_some() && a.second != a.first),
            "copies have their own jitter"
        );
        let always = Model {
            loss: 1.0,
            ..Model::default()
        };
        assert!((0..100).all(|seq| transmit(&always, 10, draws(seq)).first.is_none()));
    }

    #[test]
    fn a_draw_of_just_the_share_is_neither_lost_nor_copied() {
        let [loss, duplicate] = [LOSS, DUPLICATE].map(|index| draws(3).uniform(index));
        let at_the_edge = Model {
            loss,
            duplicate,
            ..Model::default()
        };
        let once = Arrivals {
            first: Some(0),
            second: None,
        };
        assert_eq!(transmit(&at_the_edge, 10, draws(3)), once);
        let beyond = Model {
            loss: 0.0,
            duplicate: duplicate + 1e-9,
            ..Model::default()
        };
        assert_eq!(transmit(&beyond, 10, draws(3)).second, Some(0));
        let lost = Model {
            loss: loss + 1e-9,
            ..at_the_edge
        };
        assert_eq!(transmit(&lost, 10, draws(3)).first, None);
    }

    #[test]
    fn both_parts_of_the_jitter_of_each_copy_are_draws_of_their_own() {
        let model = Model {
            fixed_ms: 100.0,
            jitter: Jitter {
                uniform_ms: 4.0,
                gaussian_ms: 2.0,
            },
            duplicate: 1.0,
            ..Model::default()
        };
        for seq in 0..20 {
            let delay = |index| {
                let (uniform, gaussian) = (draws(seq).uniform(index), draws(seq).gaussian(index + 1));
                100_000_000 + ((4.0 * (2.0 * uniform - 1.0) + 2.0 * gaussian) * 1e6).round() as Nanos
            };
            let expected = Arrivals {
                first: Some(delay(16)),
                second: Some(delay(20)),
            };
            assert_eq!(transmit(&model, 0, draws(seq)), expected, "{seq}");
        }
    }

    #[test]
    fn bytes_take_no_time_where_no_rate_is_known() {
        for bits_per_second in [None, Some(0)] {
            let model = Model {
                bits_per_second,
                ..Model::default()
            };
            assert_eq!(transmit(&model, 1000, draws(0)).first, Some(0));
        }
    }
}
