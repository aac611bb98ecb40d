//! The pillar net: a linear layer with batch norm and ReLU on every point of a pillar, and the maximum over its points
//! (PointPillars, Lang et al. 2019, Sec. 2.1; features as in V2X-Real).
//!
//! A point has ten features: x, y, z, intensity; its offset from the mean of the pillar's points; its offset from the
//! pillar's centre. All are linear in the point, so what a pillar's points share is added once, after the maximum.

use realo_kernels::canvas::Canvas;
use realo_kernels::conv::{Pool, Rows};
use realo_kernels::simd::dispatch;
use realo_nn::layers::{Layers, POINT_FEATURES};
use realo_nn::model::{Architecture, Grid, Model};
use realo_nn::weights::Weights;

use super::pillars::Pillars;

/// The layer with batch norm folded in, and the grid that it belongs to.
#[derive(Clone, Debug)]
pub struct PillarNet {
    layer: Layer,
    centers: Centers,
    /// Pillars with fewer points have empty slots that take part in the maximum.
    empty_below: Option<usize>,
}

impl PillarNet {
    /// The pillar net of a model.
    ///
    /// # Panics
    /// If the model has no layer that reads points.
    pub fn of<A: Architecture>(model: &Model<A>, weights: &Weights) -> Self {
        let layers = Layers::of(model);
        let layer = layers.points().expect("a layer that reads points");
        let settings = &model.pillars;
        let linear = weights.tensor(&layer.weight_key());
        let norm = weights.batch_norm(&layer.norm);
        let empty_below = settings.empty_slots.then_some(settings.points);
        Self::new(&model.grid, linear, &norm, empty_below, settings.intensity)
    }

    /// The net of a linear layer `[channels, 10]` and, for each channel, the factor and the summand of its batch norm.
    ///
    /// `empty_below`: in pillars with fewer points than this the empty slots take part in the maximum, with the features
    /// of a point of zeros, as in the reference. Without `intensity` all points count as having 0.
    ///
    /// # Panics
    /// If `linear` has not ten weights for each channel.
    pub fn new(grid: &Grid, linear: &[f32], norm: &[[f64; 2]], empty_below: Option<usize>, intensity: bool) -> Self {
        assert_eq!(
            linear.len(),
            norm.len() * POINT_FEATURES,
            "weights of {} channels",
            norm.len()
        );
        let centers = Centers::new(grid);
        let mut layer = Layer {
            channels: norm.len(),
            blocks: vec![Block::default(); norm.len().div_ceil(LANES)],
        };
        for (channel, (weights, [factor, summand])) in
            linear.as_chunks::<POINT_FEATURES>().0.iter().zip(norm).enumerate()
        {
            let weight = |feature: usize| f64::from(weights[feature]) * factor;
            let (block, lane) = (&mut layer.blocks[channel / LANES], channel % LANES);
            for axis in 0..3 {
                block.offset[axis][lane] = (weight(axis) + weight(4 + axis) + weight(7 + axis)) as f32;
                block.mean[axis][lane] = weight(4 + axis) as f32;
            }
            block.offset[3][lane] = if intensity { weight(3) as f32 } else { 0.0 };
            block.center[0][lane] = weight(0) as f32;
            block.center[1][lane] = weight(1) as f32;
            block.bias[lane] = (summand + weight(2) * f64::from(centers.z)) as f32;
            block.empty[lane] = (*summand as f32).max(0.0);
        }
        PillarNet {
            layer,
            centers,
            empty_below,
        }
    }

    /// Channels that it gives.
    pub fn channels(&self) -> usize {
        self.layer.channels
    }

    /// Clears the canvas and writes the features of every pillar into its cell.
    ///
    /// # Panics
    /// If the canvas has another number of rows, columns or channels than this net's grid and layer.
    pub fn run(&self, pillars: &Pillars, canvas: &mut Canvas) {
        self.run_on(pillars, canvas, &mut Pool::new(1));
    }

    /// As [`PillarNet::run`], each thread with rows of its own.
    pub(crate) fn run_on(&self, pillars: &Pillars, canvas: &mut Canvas, pool: &mut Pool) {
        self.assert_fits(canvas);
        let before = canvas.mark(&pillars.cells);
        pool.each(canvas.shares(pool.threads()), |rows| {
            let first = (rows.range.start + 1) * (self.centers.columns + 2) * self.layer.channels;
            clear(rows.data, first, self.layer.channels, &before);
            encode(self, pillars, rows);
        });
    }

    fn assert_fits(&self, canvas: &Canvas) {
        assert_eq!(
            [canvas.rows(), canvas.columns(), canvas.channels()],
            [self.centers.rows, self.centers.columns, self.layer.channels],
            "rows, columns and channels of the canvas"
        );
    }
}

/// The ten features of every point, as the layer of a net in training takes them; in the order of `pillars.points`.
/// Without `intensity` all points count as having 0.
pub fn decorate(grid: &Grid, pillars: &Pillars, intensity: bool) -> Vec<[f32; POINT_FEATURES]> {
    let centers = Centers::new(grid);
    let mut features = Vec::with_capacity(pillars.points.len());
    for (pillar, cell) in pillars.cells.iter().enumerate() {
        let points = pillars.points_of(pillar);
        let (_, _, [cx, cy, cz]) = centers.of(*cell as usize);
        let sum = |axis: usize| points.iter().map(|point| point[axis]).sum::<f32>();
        let [mx, my, mz] = [0, 1, 2].map(|axis| sum(axis) / points.len() as f32);
        features.extend(points.iter().map(|[x, y, z, i]| {
            let i = if intensity { *i } else { 0.0 };
            [*x, *y, *z, i, x - mx, y - my, z - mz, x - cx, y - cy, z - cz]
        }));
    }
    features
}

/// Channels that are computed together.
const LANES: usize = 16;
type Lanes = [f32; LANES];

/// Weights by channel, in blocks of so many channels.
#[derive(Clone, Debug)]
struct Layer {
    channels: usize,
    blocks: Vec<Block>,
}

/// The weights of some channels. The output is the positive part of
/// max over points(`offset` · offset of the point from the pillar's centre, intensity)
/// + `center` · centre − `mean` · offset of the mean from the centre + `bias`.
#[derive(Clone, Debug, Default)]
struct Block {
    offset: [Lanes; 4],
    center: [Lanes; 2],
    mean: [Lanes; 3],
    bias: Lanes,
    /// What a slot without a point gives.
    empty: Lanes,
}

/// Where the pillars of a grid stand.
#[derive(Clone, Debug)]
struct Centers {
    rows: usize,
    columns: usize,
    size: f32,
    /// Centre of the first pillar, m.
    first: [f32; 2],
    z: f32,
}

impl Centers {
    fn new(grid: &Grid) -> Self {
        let first = |from: f64| (grid.cell / 2.0 + from) as f32;
        Centers {
            rows: grid.rows(),
            columns: grid.columns(),
            size: grid.cell as f32,
            first: [first(grid.x[0]), first(grid.y[0])],
            z: ((grid.z[1] - grid.z[0]) / 2.0 + grid.z[0]) as f32,
        }
    }

    /// Row, column and centre (m) of a cell.
    #[inline(always)]
    fn of(&self, cell: usize) -> (usize, usize, [f32; 3]) {
        let (row, column) = (cell / self.columns, cell % self.columns);
        let x = column as f32 * self.size + self.first[0];
        let y = row as f32 * self.size + self.first[1];
        (row, column, [x, y, self.z])
    }
}

/// Makes the cells zero that begin at such numbers of the rows of a canvas; `data` begins at `first` of them.
fn clear(data: &mut [f32], first: usize, channels: usize, starts: &[usize]) {
    let own = first..first + data.len();
    for start in starts.iter().filter(|start| own.contains(*start)) {
        data[start - first..][..channels].fill(0.0);
    }
}

dispatch! {
    /// Writes every pillar's features into its cell, if it lies in these rows.
    fn encode(net: &PillarNet, pillars: &Pillars, rows: Rows<f32>) {
        let PillarNet { layer, centers, empty_below } = net;
        let Rows { range, data } = rows;
        let own = range.start * centers.columns..range.end * centers.columns;
        let mut offsets = Vec::new();
        for (pillar, cell) in pillars.cells.iter().enumerate() {
            let cell = *cell as usize;
            if !own.contains(&cell) {
                continue;
            }
            let points = pillars.points_of(pillar);
            let (row, column, center) = centers.of(cell);
            let mean = offsets_from(center, points, &mut offsets);
            let empty = empty_below.is_some_and(|slots| points.len() < slots);
            let start = ((row - range.start) * (centers.columns + 2) + column + 1) * layer.channels;
            let to = data[start..start + layer.channels].chunks_mut(LANES);
            for (out, block) in to.zip(&layer.blocks) {
                let features = block.features(&offsets, center, mean, empty);
                match <&mut Lanes>::try_from(&mut *out) {
                    Ok(lanes) => *lanes = features,
                    Err(_) => out.copy_from_slice(&features[..out.len()]),
                }
            }
        }
    }
}

/// Each point's offset from the pillar's centre, with its intensity; and their mean.
#[inline(always)]
fn offsets_from([cx, cy, cz]: [f32; 3], points: &[[f32; 4]], offsets: &mut Vec<[f32; 4]>) -> [f32; 3] {
    offsets.clear();
    offsets.extend(points.iter().map(|[x, y, z, i]| [x - cx, y - cy, z - cz, *i]));
    let mut sum = [0.0; 3];
    for offset in &*offsets {
        for axis in 0..3 {
            sum[axis] += offset[axis];
        }
    }
    sum.map(|sum| sum / points.len() as f32)
}

impl Block {
    #[inline(always)]
    fn features(&self, offsets: &[[f32; 4]], center: [f32; 3], mean: [f32; 3], empty: bool) -> Lanes {
        let mut best = [f32::NEG_INFINITY; LANES];
        for [x, y, z, i] in offsets {
            for lane in 0..LANES {
                let [wx, wy, wz, wi] = &self.offset;
                let value = wx[lane] * x + wy[lane] * y + wz[lane] * z + wi[lane] * i;
                best[lane] = if value > best[lane] { value } else { best[lane] };
            }
        }
        let mut features = [0.0; LANES];
        for lane in 0..LANES {
            let of_center = self.center[0][lane] * center[0] + self.center[1][lane] * center[1];
            let of_mean = self.mean[0][lane] * mean[0] + self.mean[1][lane] * mean[1] + self.mean[2][lane] * mean[2];
            let value = best[lane] + (of_center - of_mean + self.bias[lane]);
            let min = if empty { self.empty[lane] } else { 0.0 };
            features[lane] = if value > min { value } else { min };
        }
        features
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detect::pillars::{Dropped, Pillariser, Points};
    use crate::vectors::{Vector, assert_near};

    const GRID: Grid = Grid {
        x: [-102.4, 102.4],
        y: [-40.0, 40.0],
        z: [-3.0, 5.0],
        cell: 0.4,
    };

    /// Numbers in [-1, 1) without a pattern.
    fn noise(seed: u32, i: usize) -> f32 {
        let hash = (i as u32)
            .wrapping_mul(2_654_435_761)
            .wrapping_add(seed)
            .wrapping_mul(0x85eb_ca6b);
        ((hash ^ (hash >> 13)).wrapping_mul(0xc2b2_ae35) >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    fn weights(channels: usize) -> (Vec<f32>, Vec<[f64; 2]>) {
        let linear = (0..channels * POINT_FEATURES).map(|i| noise(5, i)).collect();
        let norm = (0..channels)
            .map(|c| [f64::from(noise(6, c)), f64::from(noise(7, c))])
            .collect();
        (linear, norm)
    }

    fn pillars(points: usize) -> Pillars {
        let column = |seed: u32, reach: f32| -> Vec<f32> { (0..points).map(|i| reach * noise(seed, i)).collect() };
        let (x, y, z, i) = (column(1, 10.0), column(2, 8.0), column(3, 2.9), column(4, 1.0));
        let points = Points {
            x: &x,
            y: &y,
            z: &z,
            intensity: Some(&i),
        };
        Pillariser::new(&GRID, 8, 40_000).run(&points).clone()
    }

    /// The definition: ten features, linear layer, batch norm, ReLU, maximum.
    fn plain(
        pillars: &Pillars,
        linear: &[f32],
        norm: &[[f64; 2]],
        empty_below: Option<usize>,
        intensity: bool,
    ) -> Vec<f32> {
        let decorated = decorate(&GRID, pillars, intensity);
        let mut features = Vec::new();
        for pillar in 0..pillars.len() {
            let own = &decorated[pillars.starts[pillar] as usize..pillars.starts[pillar + 1] as usize];
            for (weights, [factor, summand]) in linear.chunks(POINT_FEATURES).zip(norm) {
                let of = |point: &[f32; POINT_FEATURES]| {
                    let sum: f64 = point
                        .iter()
                        .zip(weights)
                        .map(|(a, b)| f64::from(*a) * f64::from(*b))
                        .sum();
                    (sum * factor + summand).max(0.0)
                };
                let best = own.iter().map(of).fold(0.0, f64::max);
                let empty = if empty_below.is_some_and(|slots| own.len() < slots) {
                    summand.max(0.0)
                } else {
                    0.0
                };
                features.push(best.max(empty) as f32);
            }
        }
        features
    }

    fn features(pillars: &Pillars, canvas: &Canvas) -> Vec<f32> {
        let columns = canvas.columns();
        let cells = pillars.cells.iter().map(|cell| *cell as usize);
        cells
            .flat_map(|cell| canvas.cell(cell / columns, cell % columns).to_vec())
            .collect()
    }

    #[test]
    fn is_the_plain_definition_for_any_number_of_channels() {
        let pillars = pillars(6000);
        assert!(
            pillars.dropped.over_points > 10 && pillars.len() > 500,
            "{:?}",
            pillars.dropped
        );
        for (channels, empty_below, intensity) in [
            (1, None, true),
            (16, Some(8), false),
            (21, Some(8), true),
            (32, None, false),
        ] {
            let (linear, norm) = weights(channels);
            let mut canvas = Canvas::new(GRID.rows(), GRID.columns(), channels);
            let net = PillarNet::new(&GRID, &linear, &norm, empty_below, intensity);
            net.run(&pillars, &mut canvas);
            let expected = plain(&pillars, &linear, &norm, empty_below, intensity);
            assert_near("features", &features(&pillars, &canvas), &expected, 1e-5);
            let sum = |values: &[f32]| values.iter().map(|value| f64::from(*value)).sum::<f64>();
            let difference = sum(canvas.data()) - sum(&features(&pillars, &canvas));
            assert!(
                difference.abs() < 1e-6,
                "something was written outside the pillars' cells"
            );
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits_and_a_canvas_serves_twice() {
        let pillars = pillars(3000);
        let (linear, norm) = weights(40);
        let net = PillarNet::new(&GRID, &linear, &norm, Some(8), true);
        let new_canvas = || Canvas::new(GRID.rows(), GRID.columns(), 40);
        let (mut canvas, mut portable) = (new_canvas(), new_canvas());
        net.run(&self::pillars(500), &mut canvas);
        net.run(&pillars, &mut canvas);
        portable.mark(&pillars.cells);
        let rows = portable.shares(1).remove(0);
        encode::portable(&net, &pillars, rows);
        assert_eq!(canvas, portable);
    }

    #[test]
    fn no_pillar_clears_the_canvas_and_one_pillar_fills_one_cell() {
        let (linear, norm) = weights(4);
        let net = PillarNet::new(&GRID, &linear, &norm, None, false);
        let mut canvas = Canvas::new(GRID.rows(), GRID.columns(), 4);
        let one = pillars(1);
        net.run(&one, &mut canvas);
        assert_near(
            "one",
            &features(&one, &canvas),
            &plain(&one, &linear, &norm, None, false),
            1e-5,
        );
        assert!(features(&one, &canvas).iter().any(|value| *value > 0.0));
        net.run(&Pillars::empty(), &mut canvas);
        assert_eq!(canvas, Canvas::new(GRID.rows(), GRID.columns(), 4));
    }

    #[test]
    #[should_panic(expected = "rows, columns and channels of the canvas")]
    fn a_canvas_of_another_size_is_a_bug() {
        let (linear, norm) = weights(4);
        PillarNet::new(&GRID, &linear, &norm, None, false).run(&Pillars::empty(), &mut Canvas::new(200, 512, 5));
    }

    fn net_of(vector: &Vector, slots: usize) -> PillarNet {
        let part = |name: &str| vector.f64(&format!("param.pfn_layers.0.{name}"));
        let scale = part("norm.weight").into_iter().zip(part("norm.running_var"));
        let factors = scale.map(|(weight, variance)| weight / (variance + 1e-3).sqrt());
        let shift = part("norm.bias").into_iter().zip(part("norm.running_mean"));
        let norm: Vec<_> = factors
            .zip(shift)
            .map(|(factor, (bias, mean))| [factor, bias - mean * factor])
            .collect();
        PillarNet::new(
            &crate::testing::grid_of(&vector),
            &vector.f32("param.pfn_layers.0.linear.weight"),
            &norm,
            Some(slots),
            true,
        )
    }

    /// The ragged form of a `[pillars, slots, 4]` tensor.
    fn ragged(vector: &Vector, columns: usize) -> Pillars {
        let (counts, voxels) = (vector.f64("in.num_points"), vector.rows::<4>("in.voxels"));
        let slots = voxels.len() / counts.len();
        let coordinates = vector.rows_f64::<4>("in.coords_bzyx");
        let mut pillars = Pillars::empty();
        for (pillar, count) in counts.iter().enumerate() {
            let [_, _, row, column] = coordinates[pillar].map(|index| index as u32);
            pillars.cells.push(row * columns as u32 + column);
            pillars.points.extend(&voxels[pillar * slots..][..*count as usize]);
            pillars.starts.push(pillars.points.len() as u32);
        }
        pillars
    }

    #[test]
    fn reference_features_are_met() {
        for case in ["c8", "c16"] {
            let vector = Vector::open(&format!("pillars/pillar_features_{case}.safetensors"));
            let grid = crate::testing::grid_of(&vector);
            let net = net_of(&vector, 32);
            let pillars = ragged(&vector, grid.columns());
            let mut canvas = Canvas::new(grid.rows(), grid.columns(), net.channels());
            net.run(&pillars, &mut canvas);
            assert_near(
                case,
                &features(&pillars, &canvas),
                &vector.f32("out.pillar_features"),
                1e-5,
            );

            let expected = vector.rows::<POINT_FEATURES>("mid.decorated_first16");
            let decorated = decorate(&grid, &pillars, true);
            for pillar in 0..16 {
                let own = pillars.starts[pillar] as usize..pillars.starts[pillar + 1] as usize;
                let expected = &expected[pillar * 32..][..own.len()];
                assert_near(
                    "decorated",
                    decorated[own].as_flattened(),
                    expected.as_flattened(),
                    1e-5,
                );
            }
        }
    }

    #[test]
    fn reference_canvas_is_met_from_points_on() {
        let vector = Vector::open("pillars/points_to_canvas.safetensors");
        let matrix = vector.f32("mid.matrix_agent_to_ego");
        let project = |[x, y, z, i]: [f32; 4]| {
            let [x, y, z] = [0, 4, 8].map(|r| matrix[r] * x + matrix[r + 1] * y + matrix[r + 2] * z + matrix[r + 3]);
            [x, y, z, i]
        };
        let sensor = vector.rows::<4>("in.points_sensor");
        let own = |[x, y, ..]: &[f32; 4]| !((-1.95..=2.95).contains(x) && (-1.1..=1.1).contains(y));
        let points: Vec<[f32; 4]> = sensor.into_iter().filter(own).map(project).collect();
        let within = vector.shape("mid.points_in_range")[0];

        let column = |axis: usize| -> Vec<f32> { points.iter().map(|point| point[axis]).collect() };
        let (x, y, z, i) = (column(0), column(1), column(2), column(3));
        let grid = crate::testing::grid_of(&vector);
        let mut pillariser = Pillariser::new(&grid, 32, 640_000);
        let pillars = pillariser.run(&Points {
            x: &x,
            y: &y,
            z: &z,
            intensity: Some(&i),
        });
        let out_of_range = (points.len() - within) as u64;
        assert_eq!(
            pillars.dropped,
            Dropped {
                out_of_range,
                ..Dropped::default()
            }
        );
        let net = net_of(&vector, 32);
        let mut canvas = Canvas::new(grid.rows(), grid.columns(), net.channels());
        net.run(pillars, &mut canvas);
        let expected = crate::vectors::nhwc(
            &vector.f32("out.canvas"),
            vector.shape("out.canvas").try_into().unwrap(),
        );
        let found = (0..grid.rows() * grid.columns())
            .flat_map(|cell| canvas.cell(cell / grid.columns(), cell % grid.columns()));
        assert_near("canvas", &found.copied().collect::<Vec<_>>(), &expected, 1e-4);
    }
}
