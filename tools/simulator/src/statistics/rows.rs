//! Statistics as rows of a table.

use super::{Clusters, Share, Statistics, quartiles};

/// A figure with its name; `values` are empty where the sweeps do not tell.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// What it is.
    pub name: &'static str,
    /// The figures, in the order of the name.
    pub values: Vec<f64>,
    /// Digits after the point that mean something.
    pub digits: usize,
}

impl Row {
    /// The figures as text; `-` where there are none.
    pub fn figures(&self) -> String {
        let values: Vec<String> = self.values.iter().map(|v| format!("{v:.*}", self.digits)).collect();
        match values.is_empty() {
            true => "-".into(),
            false => values.join(" / "),
        }
    }
}

impl Row {
    fn new(name: &'static str, digits: usize, values: Vec<f64>) -> Row {
        Row { name, values, digits }
    }

    /// Shares in percent; none where one of them has nothing to be a share of.
    fn shares(name: &'static str, digits: usize, shares: &[Share]) -> Row {
        let values: Option<Vec<f64>> = shares.iter().map(|share| share.percent()).collect();
        Row::new(name, digits, values.unwrap_or_default())
    }
}

impl Statistics {
    /// The figures, in the order of the table.
    pub fn rows(&self) -> Vec<Row> {
        [self.clusters(), self.directions(), self.bodies(), self.far_cars()].concat()
    }

    fn sweep_count(&self) -> f64 {
        self.sweeps.max(1) as f64
    }

    fn clusters(&self) -> Vec<Row> {
        let each = |count: usize| count as f64 / self.sweep_count();
        let Clusters {
            all,
            low,
            lowest,
            vehicle_like,
            car_like,
            strips,
        } = self.clusters;
        vec![
            Row::new("sweeps", 0, vec![self.sweeps as f64]),
            Row::new("points a sweep", 0, vec![each(self.points)]),
            Row::new("background clusters a sweep", 1, vec![each(all)]),
            Row::new("  top under 2.5 m / under 1 m", 1, vec![each(low), each(lowest)]),
            Row::new("  vehicle-like: top 0.5-2.5 m, 1-8 m long", 1, vec![each(vehicle_like)]),
            Row::new(
                "  car-like: top 1-2.2 m, 1.5-6 m long, under 3 m wide",
                1,
                vec![each(car_like)],
            ),
            Row::new(
                "  low strips: top under 0.9 m, over 2 m long, under 1 m wide, to 30 m / beyond",
                1,
                strips.map(each).to_vec(),
            ),
        ]
    }

    fn directions(&self) -> Vec<Row> {
        let of_near = |count: usize| 100.0 * count as f64 / self.within_50.max(1) as f64;
        let tilts = self
            .squared_tilts
            .map(|sum| libm::atan((sum / self.sweep_count()).sqrt()).to_degrees());
        vec![
            Row::shares(
                "background off its ring by over 0.1 m, at 0.3-1/1-2/2-3 m, %",
                0,
                &self.off_ring,
            ),
            Row::shares("points at 0.3-3 m on labelled objects, %", 0, &[self.on_objects]),
            Row::new(
                "ground (±0.25 m), of points within 50 m, %",
                0,
                vec![of_near(self.ground)],
            ),
            Row::new(
                "  0.25-0.5/-1/-1.5/-2/-2.5/-3/above, %",
                0,
                self.heights.map(of_near).to_vec(),
            ),
            Row::shares("points beyond 50 m, %", 0, &[self.beyond_50]),
            Row::shares(
                "directions (2°) without anything over 3 m within 60 m, %",
                0,
                &[self.open],
            ),
            Row::shares("headings over 5°/20° off the axes, %", 1, &self.headings),
            Row::new("ground plane within 40 m, rms pitch/roll, degrees", 2, tilts.to_vec()),
        ]
    }

    fn bodies(&self) -> Vec<Row> {
        vec![
            Row::shares("rays answered at -8 to -1°, %", 0, &self.answered[..1]),
            Row::shares("rays answered at 5 to 20°, %", 0, &self.answered[1..]),
            Row::shares("unanswered on lower car bodies, to 25 m, %", 1, &self.bodies[..1]),
            Row::shares("unanswered on lower car bodies, 25-60 m, %", 1, &self.bodies[1..]),
            Row::new(
                "returns of lower car bodies, depth into the box to 25 m, quartiles, m",
                2,
                quartiles(&self.metal[0]),
            ),
            Row::new("  25-60 m", 2, quartiles(&self.metal[1])),
            Row::new("  from 60 m", 2, quartiles(&self.metal[2])),
            Row::new(
                "window returns, depth into the box to 25 m, quartiles, m",
                2,
                quartiles(&self.windows),
            ),
        ]
    }

    fn far_cars(&self) -> Vec<Row> {
        vec![
            Row::new(
                "own points of cars at 50-70 m, quartiles",
                0,
                quartiles(&self.far[0].own),
            ),
            Row::new(
                "  background 0.3-3.5 m high within 8 m of them, points, quartiles",
                0,
                quartiles(&self.far[0].around),
            ),
            Row::new(
                "own points of cars at 70-100 m, quartiles",
                0,
                quartiles(&self.far[1].own),
            ),
            Row::new(
                "  background 0.3-3.5 m high within 8 m of them, points, quartiles",
                0,
                quartiles(&self.far[1].around),
            ),
        ]
    }
}
