//! Rows of the linear system: distances along directions, and their sums.

/// Rows that are summed at a time.
pub(crate) const ROWS: usize = 1024;
/// Partial sums of a product, added in this order whatever the processor.
const LANES: usize = 8;

/// Distances of points along directions: one row for a plane, three for a distribution.
pub(crate) struct Rows {
    /// Direction, and the point from the body's origin in the map's axes, m.
    columns: [[f32; ROWS]; 6],
    /// Distance along the direction, m.
    distance: [f32; ROWS],
    /// Square root of the row's weight.
    weight: [f32; ROWS],
    len: usize,
}

/// Sums over rows: `JᵀWJ` by its upper triangle, `JᵀWr`, and what tells how well a pose fits.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sums {
    /// 11, 12, … 16, 22, 23, … 66.
    pub products: [f64; 21],
    pub right: [f64; 6],
    /// Sum over points of the kernel's weight, of that times the square of the distance, and of that times the square of the point's
    /// distance from the body's origin.
    pub weight: f64,
    pub square: f64,
    pub lever: f64,
    /// Points in voxels that the map has, or beside them.
    pub met: u32,
    /// Points whose distance is within the kernel's width; those of them on horizontal planes; the sum of their distances, m.
    pub inliers: u32,
    pub on_ground: u32,
    pub distance: f64,
}

impl Rows {
    pub fn new() -> Self {
        Rows {
            columns: [[0.0; ROWS]; 6],
            distance: [0.0; ROWS],
            weight: [0.0; ROWS],
            len: 0,
        }
    }

    /// Adds a row; when it is the last that fits, all go into the sums.
    #[inline]
    pub fn push(&mut self, direction: [f32; 3], point: [f32; 3], distance: f32, weight: f32, sums: &mut Sums) {
        if self.len == ROWS {
            self.flush(sums);
        }
        let at = self.len;
        for axis in 0..3 {
            self.columns[axis][at] = direction[axis];
            self.columns[axis + 3][at] = point[axis];
        }
        self.distance[at] = distance;
        self.weight[at] = weight;
        self.len += 1;
    }

    /// Brings all rows into the sums.
    pub fn flush(&mut self, sums: &mut Sums) {
        // What is left of the last lanes counts nothing.
        let len = self.len.next_multiple_of(LANES);
        self.weight[self.len..len].fill(0.0);
        self.weigh(len);
        let mut next = sums.products.iter_mut();
        for i in 0..6 {
            for j in i..6 {
                if let Some(product) = next.next() {
                    *product += dot(&self.columns[i][..len], &self.columns[j][..len]);
                }
            }
            sums.right[i] += dot(&self.columns[i][..len], &self.distance[..len]);
        }
        self.len = 0;
    }

    /// Turns directions and points into rows of the Jacobian, `[s, p × s]`, times the square root of their weight; distances too.
    fn weigh(&mut self, len: usize) {
        let [sx, sy, sz, px, py, pz] = &mut self.columns;
        let directions = sx[..len].iter_mut().zip(&mut sy[..len]).zip(&mut sz[..len]);
        let points = px[..len].iter_mut().zip(&mut py[..len]).zip(&mut pz[..len]);
        let others = self.distance[..len].iter_mut().zip(&self.weight[..len]);
        for ((((sx, sy), sz), ((px, py), pz)), (distance, weight)) in directions.zip(points).zip(others) {
            (*sx, *sy, *sz) = (*sx * weight, *sy * weight, *sz * weight);
            (*px, *py, *pz) = (*py * *sz - *pz * *sy, *pz * *sx - *px * *sz, *px * *sy - *py * *sx);
            *distance *= weight;
        }
    }
}

impl Sums {
    /// Adds those of another chunk.
    pub fn add(&mut self, other: &Sums) {
        let add = |to: &mut [f64], from: &[f64]| to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        add(&mut self.products, &other.products);
        add(&mut self.right, &other.right);
        self.weight += other.weight;
        self.square += other.square;
        self.lever += other.lever;
        self.met += other.met;
        self.inliers += other.inliers;
        self.on_ground += other.on_ground;
        self.distance += other.distance;
    }

    /// The whole symmetric matrix.
    pub fn matrix(&self) -> [[f64; 6]; 6] {
        let mut matrix = [[0.0; 6]; 6];
        let places = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
        for ((i, j), product) in places.zip(self.products) {
            (matrix[i][j], matrix[j][i]) = (product, product);
        }
        matrix
    }
}

/// The sum of products, in lanes; both have one length, a multiple of [`LANES`].
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0f32; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    lanes.into_iter().map(f64::from).sum()
}

#[cfg(test)]
mod tests {
    use damage::Draw;

    use super::*;

    #[test]
    fn sums_are_those_of_the_formula() {
        let mut draw = Draw::new(6);
        let (mut rows, mut sums) = (Rows::new(), Sums::default());
        let (mut products, mut right) = ([[0f64; 6]; 6], [0f64; 6]);
        for _ in 0..2500 {
            let mut number = || draw.below(2_000_000) as f32 * 1e-6 - 1.0;
            let (s, p) = (
                [number(), number(), number()],
                [60.0 * number(), 60.0 * number(), 9.0 * number()],
            );
            let (distance, weight) = (number(), number().abs());
            rows.push(s, p, distance, weight, &mut sums);
            let cross = [
                p[1] * s[2] - p[2] * s[1],
                p[2] * s[0] - p[0] * s[2],
                p[0] * s[1] - p[1] * s[0],
            ];
            let j: [f64; 6] = std::array::from_fn(|i| f64::from(if i < 3 { s[i] } else { cross[i - 3] }));
            let square = f64::from(weight) * f64::from(weight);
            for a in 0..6 {
                right[a] += square * j[a] * f64::from(distance);
                (0..6).for_each(|b| products[a][b] += square * j[a] * j[b]);
            }
        }
        rows.flush(&mut sums);
        let found = sums.matrix();
        for a in 0..6 {
            let scale = (products[a][a] * 2500.0).sqrt();
            assert!((sums.right[a] - right[a]).abs() < 1e-6 * scale, "{a}");
            for b in 0..6 {
                let scale = (products[a][a] * products[b][b]).sqrt();
                assert!((found[a][b] - products[a][b]).abs() < 1e-5 * scale, "{a} {b}");
            }
        }
    }

    #[test]
    fn without_rows_there_are_no_sums() {
        let mut sums = Sums::default();
        Rows::new().flush(&mut sums);
        assert_eq!(sums, Sums::default());
    }
}
