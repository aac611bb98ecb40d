use nalgebra::{Matrix2, Vector2};
use realo_schemas::geometry::normalize_yaw;
use realo_schemas::{Nanos, to_seconds};

use crate::Offset;
use crate::turning::{Angle, Heading, YawRate};

/// Rates that are farther apart have a gap between them, ns.
const GAP: Nanos = 100_000_000;
/// Headings that are farther apart begin a new piece, ns.
const HEADING_GAP: Nanos = 500_000_000;
/// Longest piece with one constant, ns: over longer ones the noise of the gyro adds up.
const PIECE: Nanos = 5_000_000_000;
/// Stamps lie within plus and minus so much, ns, so that their differences fit: until 2116.
const LATEST: Nanos = Nanos::MAX / 2;
/// Headings that are needed.
const FEWEST: usize = 30;
/// Step of the search, ns. Turning of vehicles has no parts that change faster.
const STEP: Nanos = 20_000_000;
/// Widest search, ns.
const LONGEST: Nanos = 10_000_000_000;
/// Rounds of refinement, and the step at which it ends, ns.
const REFINE: (usize, f64) = (20, 1_000.0);
/// What interpolation between rates and rounding of stamps add to the bound, ns.
const FLOOR: f64 = 200_000.0;
/// Standard deviations of a bound by very many pieces: 98 %.
const SIGMAS: f64 = 2.326;
/// Standard deviation of headings, rad, where the fit does not show it.
const EXPECTED: f64 = 3.5e-3;

/// What an estimate from motion may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionLimits {
    /// Offsets are searched within plus and minus so much, ns; from 20 ms to 10 s.
    pub largest: Nanos,
    /// A wider bound is no estimate, ns.
    pub bound: Nanos,
}

impl Default for MotionLimits {
    fn default() -> Self {
        MotionLimits {
            largest: 500_000_000,
            bound: 5_000_000,
        }
    }
}

/// Why motion does not show an offset.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum NoMotionOffset {
    /// Samples with NaN or infinity, or stamps that do not rise.
    #[error("expected finite {0} with rising stamps; leave the others out before")]
    Unsound(&'static str),
    /// Too few headings within the time of the rates.
    #[error("expected at least {FEWEST} headings within the time of the yaw rates, found {0}; record for longer")]
    Few(usize),
    /// Too little turning to say it well enough.
    #[error(
        "the turning shows the offset to {found:.1} ms only, {limit:.1} ms are needed; drive curves, or record for longer"
    )]
    Straight {
        /// Bound that was found, ms.
        found: f64,
        /// Largest allowed, ms.
        limit: f64,
    },
    /// The best fit is at the end of the search.
    #[error("the offset is beyond the ±{0:.0} ms that are searched; look at the sensors' clocks")]
    Beyond(f64),
    /// Another offset fits nearly as well.
    #[error("offsets {0:.0} ms apart fit alike; drive other curves, or record for longer")]
    Ambiguous(f64),
}

impl NoMotionOffset {
    /// Of bounds in ns.
    fn straight(found: f64, limit: f64) -> Self {
        NoMotionOffset::Straight {
            found: found * 1e-6,
            limit: limit * 1e-6,
        }
    }
}

/// The offset of an IMU's clock from a scanner's: what is to be added to a stamp of the IMU to have the scanner's time.
///
/// Headings are fitted by the integrated yaw rate, shifted in time; each piece of at most 5 s has a constant of its own, and all
/// have one bias of the gyro. The bound is 3.3 standard deviations with six pieces and 2.7 with twelve (Student's t), by the residuals, or by how far pieces differ from each
/// other, whichever is wider: the noise of a gyro adds up within a piece.
///
/// # Errors
/// [`NoMotionOffset`] where the motion does not show it.
pub fn motion_offset(rates: &[YawRate], headings: &[Heading], limits: &MotionLimits) -> Result<Offset, NoMotionOffset> {
    check(rates.iter().map(|rate| (rate.stamp, rate.rate)), "yaw rates")?;
    check(headings.iter().map(|heading| (heading.stamp, heading.yaw)), "headings")?;
    let largest = limits.largest.clamp(STEP, LONGEST);
    let fit = Fit {
        angle: Angle::new(rates, GAP),
        pieces: pieces(headings, rates, largest),
    };
    let count = fit.pieces.iter().map(Vec::len).sum();
    if count < FEWEST {
        return Err(NoMotionOffset::Few(count));
    }
    let (start, second) = fit.search(largest, limits.bound)?;
    let (shift, last) = fit.refine(start);
    let variance = last.square / (last.count - 2.0 - last.pieces).max(1.0);
    if let Some((other, square)) = second
        && square < last.square + 25.0 * variance
    {
        return Err(NoMotionOffset::Ambiguous((other - shift).abs() * 1e-6));
    }
    let by_pieces = last.scores / (last.information * last.information);
    let sigma = (variance / last.information).max(by_pieces).sqrt() * 1e9;
    let bound = sigmas(last.pieces) * sigma + FLOOR;
    if bound.is_nan() || bound > limits.bound as f64 {
        return Err(NoMotionOffset::straight(bound, limits.bound as f64));
    }
    Ok(Offset {
        offset: -(shift.round() as Nanos),
        bound: bound.ceil() as Nanos,
        drift: 0.0,
        at: rates.last().map_or(0, |rate| rate.stamp),
    })
}

/// Standard deviations of a bound by so many pieces: Student's t by the first terms of its series (Fisher and Cornish 1960).
fn sigmas(pieces: f64) -> f64 {
    let (z, freedom) = (SIGMAS, (pieces - 1.0).max(1.0));
    let [cube, fifth] = [z * z * z, z * z * z * z * z];
    z + (cube + z) / (4.0 * freedom) + (5.0 * fifth + 16.0 * cube + 3.0 * z) / (96.0 * freedom * freedom)
}

fn check(samples: impl Iterator<Item = (Nanos, f64)>, what: &'static str) -> Result<(), NoMotionOffset> {
    let mut last = None;
    for (stamp, value) in samples {
        let is_far = stamp.unsigned_abs() > LATEST.unsigned_abs();
        if !value.is_finite() || is_far || last.is_some_and(|last| stamp <= last) {
            return Err(NoMotionOffset::Unsound(what));
        }
        last = Some(stamp);
    }
    Ok(())
}

/// Headings, unwrapped, in pieces; those that all shifts leave within the time of the rates.
fn pieces(headings: &[Heading], rates: &[YawRate], largest: Nanos) -> Vec<Vec<(Nanos, f64)>> {
    let mut pieces: Vec<Vec<(Nanos, f64)>> = Vec::new();
    let (Some(first), Some(last)) = (rates.first(), rates.last()) else {
        return pieces;
    };
    let within = first.stamp.saturating_add(largest)..last.stamp.saturating_sub(largest);
    for heading in headings.iter().filter(|heading| within.contains(&heading.stamp)) {
        let goes_on = pieces.last().and_then(|piece| Some((*piece.first()?, *piece.last()?)));
        match goes_on {
            Some((begun, (stamp, yaw))) if heading.stamp - stamp <= HEADING_GAP && heading.stamp - begun.0 <= PIECE => {
                let yaw = yaw + normalize_yaw(heading.yaw - yaw);
                if let Some(piece) = pieces.last_mut() {
                    piece.push((heading.stamp, yaw));
                }
            }
            _ => pieces.push(vec![(heading.stamp, heading.yaw)]),
        }
    }
    pieces
}

struct Fit<'a> {
    angle: Angle<'a>,
    pieces: Vec<Vec<(Nanos, f64)>>,
}

/// A fit at one shift.
struct Fitted {
    /// Sum of squared residuals, rad².
    square: f64,
    count: f64,
    pieces: f64,
    /// The step to a better shift, ns.
    step: f64,
    /// Information on the shift, 1/s² for residuals of 1 rad.
    information: f64,
    /// Sum of the pieces' squared shares in the step, rad⁴/s², as of a sample of pieces.
    scores: f64,
}

/// One row of the fit: time, what is left of the heading, and the rate; their piece's means taken off.
type Row = [f64; 3];

impl Fit<'_> {
    /// The shift with the least squares on a grid, and the best other valley with its squares.
    fn search(&self, largest: Nanos, bound: Nanos) -> Result<(f64, Option<(f64, f64)>), NoMotionOffset> {
        let steps = largest / STEP;
        let squares: Vec<f64> = (-steps..=steps)
            .map(|step| {
                self.at((step * STEP) as f64)
                    .map_or(f64::INFINITY, |fitted| fitted.square)
            })
            .collect();
        let best = (0..squares.len())
            .min_by(|a, b| squares[*a].total_cmp(&squares[*b]))
            .unwrap_or(0);
        let shift = |number: usize| ((number as i64 - steps) * STEP) as f64;
        let Some(fitted) = self.at(shift(best)) else {
            return Err(NoMotionOffset::Few(0));
        };
        if best == 0 || best + 1 == squares.len() {
            let found = sigmas(fitted.pieces) * EXPECTED / fitted.information.sqrt() * 1e9;
            let limit = bound as f64;
            return Err(if found > limit {
                NoMotionOffset::straight(found, limit)
            } else {
                NoMotionOffset::Beyond(largest as f64 * 1e-6)
            });
        }
        let is_valley = |number: &usize| {
            let at = *number;
            at > 0 && at + 1 < squares.len() && squares[at] <= squares[at - 1] && squares[at] <= squares[at + 1]
        };
        let second = (0..squares.len())
            .filter(is_valley)
            .filter(|at| at.abs_diff(best) > 1)
            .min_by(|a, b| squares[*a].total_cmp(&squares[*b]));
        Ok((shift(best), second.map(|at| (shift(at), squares[at]))))
    }

    /// Gauss and Newton from a shift of the search.
    fn refine(&self, start: f64) -> (f64, Fitted) {
        let mut shift = start;
        let mut best = self.at(shift).unwrap_or_else(Fitted::nothing);
        for _ in 0..REFINE.0 {
            let step = best.step.clamp(-(STEP as f64), STEP as f64);
            let Some(next) = self.at(shift + step) else { break };
            if next.square.is_nan() || next.square > best.square {
                break;
            }
            shift += step;
            best = next;
            if step.abs() < REFINE.1 {
                break;
            }
        }
        (shift, best)
    }

    /// Rows of the fit with headings at their stamps plus a shift, by the IMU's clock, each with the number of its piece.
    fn rows(&self, shift: Nanos) -> Vec<(usize, Row)> {
        let mut rows: Vec<(usize, Row)> = Vec::new();
        for (piece, headings) in self.pieces.iter().enumerate() {
            let from = rows.len();
            let mut sum = [0.0; 3];
            for (stamp, yaw) in headings {
                let Some((angle, rate)) = self.angle.at(stamp + shift) else {
                    continue;
                };
                let row = [to_seconds(stamp - headings[0].0), yaw - angle, rate];
                sum = [sum[0] + row[0], sum[1] + row[1], sum[2] + row[2]];
                rows.push((piece, row));
            }
            let count = (rows.len() - from).max(1) as f64;
            for (_, row) in &mut rows[from..] {
                *row = [
                    row[0] - sum[0] / count,
                    row[1] - sum[1] / count,
                    row[2] - sum[2] / count,
                ];
            }
        }
        rows
    }

    /// The fit at a shift, ns; `None` with too few headings within the time of the rates.
    fn at(&self, shift: f64) -> Option<Fitted> {
        let rows = self.rows(shift.round() as Nanos);
        if rows.len() < FEWEST {
            return None;
        }
        // yaw − angle = rate · (step of the shift) − bias · time.
        let mut normal = Matrix2::zeros();
        let mut right = Vector2::zeros();
        for (_, [time, left, rate]) in &rows {
            normal += Matrix2::new(rate * rate, -rate * time, -rate * time, time * time);
            right += Vector2::new(rate * left, -time * left);
        }
        let determinant = normal.m11 * normal.m22 - normal.m12 * normal.m12;
        // How much of the rate the bias does not explain.
        let information = if normal.m22 > 0.0 {
            determinant / normal.m22
        } else {
            0.0
        };
        let plain = if normal.m22 > 0.0 { right.y / normal.m22 } else { 0.0 };
        let (step, bias) = if information > 1e-12 {
            let step = (right.x * normal.m22 - right.y * normal.m12) / determinant;
            (step, (right.y - normal.m12 * step) / normal.m22)
        } else {
            (0.0, plain)
        };
        // The rate without what looks like a bias: it shows the shift.
        let share = if normal.m22 > 0.0 { normal.m12 / normal.m22 } else { 0.0 };
        let (mut square, mut scores) = (0.0, vec![0.0; self.pieces.len()]);
        for (piece, [time, left, rate]) in &rows {
            let residual = left + plain * time;
            square += residual * residual;
            scores[*piece] += (rate + share * time) * (left + bias * time - step * rate);
        }
        let pieces = self.pieces.len() as f64;
        let scores = scores.iter().map(|score| score * score).sum::<f64>();
        Some(Fitted {
            square,
            count: rows.len() as f64,
            pieces,
            step: step * 1e9,
            information,
            scores: scores * pieces / (pieces - 1.0).max(1.0),
        })
    }
}

impl Fitted {
    fn nothing() -> Self {
        Fitted {
            square: f64::INFINITY,
            count: 0.0,
            pieces: 0.0,
            step: 0.0,
            information: 0.0,
            scores: 0.0,
        }
    }
}
