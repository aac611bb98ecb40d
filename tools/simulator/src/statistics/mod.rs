//! What a cloud is like: the figures in which simulated clouds are held against real ones.
//!
//! All figures are of what an agent's own log holds: points in its body frame, boxes of what it was labelled with. The
//! ground is estimated from the cloud. *Background* is what stands over the ground outside all boxes, which are taken
//! 0.3 m larger; it and the clusters are looked for in the *labelled sector* ahead of the sensor.

mod cars;
mod clusters;
mod ground;
mod rings;
mod rows;

use std::collections::BTreeMap;
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::ops::Range;

use realo_schemas::{Box3, PointCloud};

use cars::into_box;
use clusters::clusters;
use ground::Ground;
use rings::{Ring, column_step, rings};
pub use rows::Row;

/// The sector in which DAIR-V2X's vehicles are labelled, rad: their cameras' view.
pub const VEHICLE_SECTOR: f64 = 118.0 * PI / 180.0;
/// The same for its roadside units.
pub const ROADSIDE_SECTOR: f64 = 51.0 * PI / 180.0;

/// Boxes are taken so much larger on each side, m: labels are not exact, and objects move within a sweep.
const MARGIN: f64 = 0.3;
/// Up to here cars are near, m.
const NEAR: f64 = 25.0;
/// Beyond it they are far, m.
const MIDDLING: f64 = 60.0;
/// Distances in which far cars are told apart, m.
const FAR: [Range<f64>; 2] = [50.0..70.0, 70.0..100.0];
/// Cars with fewer points are left out there.
const LEAST_POINTS: usize = 5;
/// Low strips are far from here on, m.
const STRIPS_FAR: f64 = 30.0;
/// What rises less is ground, m.
const ABOVE_GROUND: f64 = 0.25;
/// Around a far car, m.
const AROUND: f64 = 8.0;
/// Heights of a car's lower body and of its windows, as shares of the car's.
const LOWER_BODY: Range<f64> = 0.2..0.5;
const WINDOWS: Range<f64> = 0.65..0.9;
/// Upper limits of the bins of height over ground, m.
const HEIGHTS: [f64; 6] = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0];

/// A sweep and what is known about it.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// The points, in the agent's body frame.
    pub cloud: &'a PointCloud,
    /// The sensor in the body frame, m.
    pub sensor: [f64; 3],
    /// Width of the labelled sector ahead of the sensor, rad.
    pub sector: f64,
    /// The labelled objects, in the body frame.
    pub objects: &'a [Box3],
    /// Elevations of the beams to thin the cloud to, rad: of its rings those nearest to them count. Empty: all count.
    pub beams: &'a [f64],
}

impl Observed<'_> {
    /// Distance of an object from the sensor along the ground, m.
    fn range(&self, object: &Box3) -> f64 {
        let [x, y] = [0, 1].map(|k| object.center[k] - self.sensor[k]);
        x.hypot(y)
    }

    /// Height of a point relative to the sensor in an object's box, as a share of the box's.
    fn share(&self, object: &Box3, point: &[f64; 3]) -> f64 {
        (point[2] + self.sensor[2] - object.center[2]) / object.height + 0.5
    }
}

/// Figures of any number of sweeps.
#[derive(Clone, Debug, Default)]
pub struct Statistics {
    sweeps: usize,
    whole_sweeps: usize,
    points: usize,
    clusters: Clusters,
    off_ring: [Share; 3],
    on_objects: Share,
    within_50: usize,
    ground: usize,
    heights: [usize; 7],
    beyond_50: Share,
    open: Share,
    headings: [Share; 2],
    squared_tilts: [f64; 2],
    answered: [Share; 2],
    bodies: [Share; 2],
    windows: Vec<f64>,
    metal: [Vec<f64>; 3],
    far: [FarCars; 2],
}

/// Of each far car its points, and those of background around it.
#[derive(Clone, Debug, Default)]
struct FarCars {
    own: Vec<f64>,
    around: Vec<f64>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Clusters {
    all: usize,
    low: usize,
    lowest: usize,
    vehicle_like: usize,
    car_like: usize,
    strips: [usize; 2],
}

/// Some of all.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    some: usize,
    all: usize,
}

impl Share {
    fn count(&mut self, holds: bool) {
        self.some += usize::from(holds);
        self.all += 1;
    }

    fn percent(self) -> Option<f64> {
        (self.all > 0).then(|| 100.0 * self.some as f64 / self.all as f64)
    }
}

/// A sweep, taken apart.
struct Parts<'a> {
    observed: &'a Observed<'a>,
    /// Relative to the sensor.
    points: Vec<[f64; 3]>,
    /// Height of each point above ground, m.
    above: Vec<f64>,
    /// The object that each point lies on.
    object: Vec<Option<usize>>,
    rings: Vec<Ring>,
}

impl Statistics {
    /// Sweeps whose beams is unknown, so that all of their points count whatever beams were asked for.
    pub fn whole_sweeps(&self) -> usize {
        self.whole_sweeps
    }

    /// Adds a sweep.
    pub fn add(&mut self, observed: &Observed) {
        let thinned = thin(observed);
        self.whole_sweeps += usize::from(thinned.is_none() && !observed.beams.is_empty());
        let observed = Observed {
            cloud: thinned.as_ref().unwrap_or(observed.cloud),
            ..*observed
        };
        let cloud = observed.cloud;
        let points: Vec<[f64; 3]> = (0..cloud.len())
            .map(|i| [0, 1, 2].map(|k| f64::from([cloud.x[i], cloud.y[i], cloud.z[i]][k]) - observed.sensor[k]))
            .collect();
        let ground = Ground::new(&points);
        let plane = ground.plane;
        let parts = Parts {
            above: points.iter().map(|p| p[2] - ground.height(p[0], p[1])).collect(),
            object: points.iter().map(|p| object(&observed, p)).collect(),
            rings: rings(cloud, &points),
            points,
            observed: &observed,
        };
        self.sweeps += 1;
        self.points += cloud.len();
        self.squared_tilts[0] += plane[1] * plane[1];
        self.squared_tilts[1] += plane[2] * plane[2];
        self.add_clusters(&parts);
        self.add_points(&parts);
        self.add_rings(&parts);
        self.add_directions(&parts);
        self.add_bodies(&parts);
        self.add_depths(&parts);
        self.add_far_cars(&parts);
        for object in observed
            .objects
            .iter()
            .filter(|object| object.length > 3.0 && in_region(&object.center, 100.0, 40.0))
        {
            let off = (object.yaw - FRAC_PI_2 * (object.yaw / FRAC_PI_2).round())
                .abs()
                .to_degrees();
            self.headings[0].count(off > 5.0);
            self.headings[1].count(off > 20.0);
        }
    }

    fn add_clusters(&mut self, parts: &Parts) {
        let sensor = parts.observed.sensor;
        let raised = parts.background(0.3, 3.5).filter(|i| parts.in_sector(*i));
        let raised: Vec<[f64; 3]> = raised
            .map(|i| {
                [
                    parts.points[i][0] + sensor[0],
                    parts.points[i][1] + sensor[1],
                    parts.above[i],
                ]
            })
            .collect();
        for cluster in clusters(&raised) {
            let (top, length) = (cluster.top, cluster.length);
            let counts = &mut self.clusters;
            counts.all += 1;
            counts.low += usize::from(top < 2.5);
            counts.lowest += usize::from(top < 1.0);
            counts.vehicle_like += usize::from((0.5..2.5).contains(&top) && (1.0..8.0).contains(&length));
            let car = (1.0..2.2).contains(&top) && (1.5..6.0).contains(&length) && cluster.width < 3.0;
            counts.car_like += usize::from(car);
            let [x, y] = [0, 1].map(|k| cluster.middle[k] - sensor[k]);
            let strip = top < 0.9 && length >= 2.0 && cluster.width < 1.0;
            counts.strips[usize::from(x.hypot(y) >= STRIPS_FAR)] += usize::from(strip);
        }
    }

    fn add_points(&mut self, parts: &Parts) {
        for (i, point) in parts.points.iter().enumerate() {
            let (above, level) = (parts.above[i], point[0].hypot(point[1]));
            if (0.3..3.0).contains(&above) && parts.in_sector(i) && in_region(point, 100.0, 40.0) {
                self.on_objects.count(parts.object[i].is_some());
            }
            self.beyond_50.count(level > 50.0);
            if level > 50.0 {
                continue;
            }
            self.within_50 += 1;
            if above.abs() <= 0.25 {
                self.ground += 1;
            } else if above > 0.0 {
                self.heights[HEIGHTS.partition_point(|limit| *limit <= above)] += 1;
            }
        }
    }

    fn add_rings(&mut self, parts: &Parts) {
        for ring in &parts.rings {
            for (index, deviation) in ring.deviations() {
                let (i, above) = (index as usize, parts.above[index as usize]);
                if parts.object[i].is_some() || !parts.in_sector(i) {
                    continue;
                }
                for (bin, limits) in [0.3..1.0, 1.0..2.0, 2.0..3.0].iter().enumerate() {
                    if limits.contains(&above) {
                        self.off_ring[bin].count(deviation > 0.1);
                    }
                }
            }
        }
        let Some(step) = column_step(&parts.rings) else { return };
        for (band, [from, to]) in [[-8.0, -1.0], [5.0, 20.0]].iter().enumerate() {
            let beams: Vec<&Ring> = parts
                .rings
                .iter()
                .filter(|ring| (*from..*to).contains(&ring.elevation.to_degrees()))
                .collect();
            // A beam of which a sector has nothing is there all the same; what is near may look like a beam of its own.
            let sectors = beams.iter().map(|ring| ring.sector + 1).max().unwrap_or(1);
            let mut counts = vec![0; sectors];
            beams.iter().for_each(|ring| counts[ring.sector] += 1);
            counts.sort_unstable();
            let most = counts[(sectors - 1) * 4 / 5];
            self.answered[band].some += beams.iter().map(|ring| ring.points.len()).sum::<usize>();
            self.answered[band].all += most * (TAU / step).round() as usize;
        }
    }

    fn add_directions(&mut self, parts: &Parts) {
        let mut open = [true; 180];
        for (i, point) in parts.points.iter().enumerate() {
            let direction = (libm::atan2(point[1], point[0]) + PI).to_degrees() * 0.5;
            if parts.above[i] > 3.0 && point[0].hypot(point[1]) < 60.0 {
                open[(direction as usize).min(179)] = false;
            }
        }
        let half = parts.observed.sector / 2.0;
        for (direction, open) in open.iter().enumerate() {
            let middle = ((direction as f64 + 0.5) * 2.0).to_radians() - PI;
            if middle.abs() < half {
                self.open.count(*open);
            }
        }
    }
}

impl Parts<'_> {
    fn in_sector(&self, i: usize) -> bool {
        let [x, y, _] = self.points[i];
        libm::atan2(y, x).abs() < self.observed.sector / 2.0
    }

    fn background(&self, from: f64, to: f64) -> impl Iterator<Item = usize> + '_ {
        (0..self.points.len()).filter(move |i| self.object[*i].is_none() && (from..to).contains(&self.above[*i]))
    }
}

fn in_region(point: &[f64; 3], x: f64, y: f64) -> bool {
    point[0].abs() < x && point[1].abs() < y
}

fn is_car(object: &Box3) -> bool {
    (3.0..5.2).contains(&object.length) && object.height < 2.4
}

fn quartiles(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    [1, 2, 3]
        .iter()
        .filter_map(|k| sorted.get(sorted.len() * k / 4))
        .copied()
        .collect()
}

/// The first object on which a point lies.
fn object(observed: &Observed, point: &[f64; 3]) -> Option<usize> {
    observed.objects.iter().position(|object| {
        let [x, y] = [0, 1].map(|k| point[k] + observed.sensor[k] - object.center[k]);
        let reach = 0.5 * (object.length + object.width) + 2.0 * MARGIN;
        if x.abs() > reach || y.abs() > reach {
            return false;
        }
        let half = [object.length, object.width, object.height].map(|size| size / 2.0 + MARGIN);
        let inside = into_box(observed, object, point);
        (0..3).all(|k| inside[k].abs() <= half[k])
    })
}

/// The cloud with only those of its rings that lie nearest to beams; `None` if all are to count, or if it has no rings.
fn thin(observed: &Observed) -> Option<PointCloud> {
    let cloud = observed.cloud;
    if observed.beams.is_empty() {
        return None;
    }
    let points: Vec<[f64; 3]> = (0..cloud.len())
        .map(|i| [0, 1, 2].map(|k| f64::from([cloud.x[i], cloud.y[i], cloud.z[i]][k]) - observed.sensor[k]))
        .collect();
    // Where beams are not numbered, each sector has rings of its own.
    let mut sectors: BTreeMap<usize, Vec<Ring>> = BTreeMap::new();
    for ring in rings(cloud, &points) {
        sectors.entry(ring.sector).or_default().push(ring);
    }
    if sectors.is_empty() {
        return None;
    }
    let mut kept: Vec<usize> = Vec::new();
    for rings in sectors.values_mut() {
        for beam in observed.beams {
            let off = |ring: &Ring| (ring.elevation - beam).abs();
            if let Some(best) = (0..rings.len()).min_by(|a, b| off(&rings[*a]).total_cmp(&off(&rings[*b]))) {
                kept.extend(rings.swap_remove(best).points.iter().map(|seen| seen.index as usize));
            }
        }
    }
    kept.sort_unstable();
    fn pick<T: Copy>(column: &[T], kept: &[usize]) -> Vec<T> {
        kept.iter().map(|i| column[*i]).collect()
    }
    PointCloud::new(
        pick(&cloud.x, &kept),
        pick(&cloud.y, &kept),
        pick(&cloud.z, &kept),
        pick(&cloud.intensity, &kept),
        pick(&cloud.time, &kept),
        pick(&cloud.ring, &kept),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::{Options, Sensor, Simulation, Sweep};

    fn values(statistics: &Statistics, name: &str) -> Vec<f64> {
        let rows = statistics.rows();
        let row = rows.iter().find(|row| row.name.contains(name));
        row.unwrap_or_else(|| panic!("no row {name}")).values.clone()
    }

    /// An agent's first sweep on a grid.
    fn first_sweep(agent: &str) -> Sweep {
        let options = Options {
            seed: 900,
            seconds: 0.2,
            agents: vec![agent.into()],
            ..Options::default()
        };
        Simulation::new(&options).unwrap().sweep(0, 0).0
    }

    /// A cloud whose beams have no numbers.
    fn unnumbered(cloud: &PointCloud) -> PointCloud {
        PointCloud {
            ring: vec![0u16; cloud.len()].into(),
            ..cloud.clone()
        }
    }

    /// A street of walls, whose beams' numbers are known: they are found from the elevations alone as well.
    #[test]
    fn figures_do_not_depend_on_numbered_beams() {
        let sweep = first_sweep("rsu1");
        let bare = unnumbered(&sweep.cloud);
        let figures = [&sweep.cloud, &bare].map(|cloud| {
            let mut statistics = Statistics::default();
            statistics.add(&Observed {
                cloud,
                sensor: [0.0, 0.0, 5.0],
                sector: VEHICLE_SECTOR,
                objects: &sweep.truth,
                beams: &[],
            });
            statistics
        });
        for name in ["rays answered at -8", "off its ring", "25-60 m"] {
            let [reported, found] = figures.each_ref().map(|statistics| values(statistics, name));
            assert!(
                !reported.is_empty() && reported.len() == found.len(),
                "{name}: {reported:?}, {found:?}"
            );
            for (reported, found) in reported.iter().zip(&found) {
                assert!(
                    (reported - found).abs() < 4.0,
                    "{name}: {reported} by numbers, {found} by elevations"
                );
            }
        }
        assert_eq!(values(&figures[0], "points a sweep"), [sweep.cloud.len() as f64]);
    }

    #[test]
    fn thinning_keeps_the_nearest_beams() {
        let sweep = first_sweep("cav1");
        let observed = Observed {
            cloud: &sweep.cloud,
            sensor: [0.0, 0.0, 1.9],
            sector: VEHICLE_SECTOR,
            objects: &[],
            beams: &[f64::to_radians(-10.0), f64::to_radians(0.0)],
        };
        let thinned = thin(&observed).unwrap();
        let mut rings: Vec<u16> = thinned.ring.to_vec();
        rings.sort_unstable();
        rings.dedup();
        let elevations = Sensor::ruby_plus().elevations();
        let off = |ring: u16, beam: f64| (elevations[usize::from(ring)].to_degrees() - beam).abs();
        let nearest = |beam: f64| (0..elevations.len() as u16).min_by(|a, b| off(*a, beam).total_cmp(&off(*b, beam)));
        assert_eq!(rings, [nearest(-10.0).unwrap(), nearest(0.0).unwrap()]);
        let all = sweep.cloud.ring.iter().filter(|ring| rings.contains(ring)).count();
        assert_eq!(thinned.len(), all);
    }

    #[test]
    fn thinning_by_all_beams_keeps_a_cloud_whose_beams_have_no_numbers() {
        let sweep = first_sweep("cav1");
        let bare = unnumbered(&sweep.cloud);
        let beams = Sensor::ruby_plus().elevations();
        let mut observed = Observed {
            cloud: &bare,
            sensor: [0.0, 0.0, 1.9],
            sector: VEHICLE_SECTOR,
            objects: &[],
            beams: &beams,
        };
        let kept = thin(&observed).unwrap().len();
        assert!(kept > bare.len() * 9 / 10, "{kept} of {}", bare.len());
        let few = [-10.0, 0.0].map(f64::to_radians);
        observed.beams = &few;
        assert!(thin(&observed).unwrap().len() < bare.len() / 20);

        // On one level there are no beams to tell.
        let flat = PointCloud {
            z: vec![1.9f32; bare.len()].into(),
            ..bare.clone()
        };
        observed.cloud = &flat;
        let mut statistics = Statistics::default();
        statistics.add(&observed);
        assert_eq!(statistics.whole_sweeps(), 1);
        assert_eq!(values(&statistics, "points a sweep"), [bare.len() as f64]);
    }

    #[test]
    fn bodies_on_a_grid_fill_their_boxes_unless_rounded_ones_are_asked_for() {
        let depth = |rounded_bodies: bool| {
            let options = Options {
                seed: 900,
                seconds: 0.1,
                agents: vec!["cav1".into()],
                rounded_bodies,
                ..Options::default()
            };
            let (sweep, _) = Simulation::new(&options).unwrap().sweep(0, 0);
            let mut statistics = Statistics::default();
            statistics.add(&Observed {
                cloud: &sweep.cloud,
                sensor: [0.0, 0.0, 1.9],
                sector: VEHICLE_SECTOR,
                objects: &sweep.truth,
                beams: &[],
            });
            values(&statistics, "returns of lower car bodies")[1]
        };
        let [filled, rounded] = [false, true].map(depth);
        assert!(filled < 0.05 && rounded > 0.1, "{filled} and {rounded} m");
    }

    /// Points in a row, from the first in steps along x and y.
    fn line(count: usize, [x, y, z]: [f32; 3], [dx, dy]: [f32; 2]) -> Vec<[f32; 3]> {
        (0..count)
            .map(|i| i as f32)
            .map(|i| [x + dx * i, y + dy * i, z])
            .collect()
    }

    /// Of points over flat ground, seen from 2 m over it.
    fn over_flat_ground<const N: usize>(things: [Vec<[f32; 3]>; N], objects: &[Box3]) -> Statistics {
        let ground = (0..4000).map(|step| [(step % 80) as f32, (step / 80) as f32 - 25.0, 0.0]);
        let points: Vec<[f32; 3]> = ground.chain(things.into_iter().flatten()).collect();
        let column = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let cloud = PointCloud {
            x: column(0).into(),
            y: column(1).into(),
            z: column(2).into(),
            intensity: vec![0; points.len()].into(),
            time: vec![0; points.len()].into(),
            ring: vec![0; points.len()].into(),
        };
        let mut statistics = Statistics::default();
        statistics.add(&Observed {
            cloud: &cloud,
            sensor: [0.0, 0.0, 2.0],
            sector: VEHICLE_SECTOR,
            objects,
            beams: &[],
        });
        statistics
    }

    #[test]
    fn strips_are_low_long_and_thin() {
        let statistics = over_flat_ground(
            [
                // One near, two far.
                line(12, [15.0, 5.0, 0.6], [0.1, 0.2]),
                line(12, [50.0, 5.0, 0.6], [0.1, 0.2]),
                line(30, [60.0, -5.0, 0.8], [0.1, 0.0]),
                // Too high, too short, too wide.
                line(12, [50.0, -10.0, 1.2], [0.0, 0.2]),
                line(9, [50.0, -15.0, 0.6], [0.0, 0.2]),
                [0.0, 0.3, 0.6, 0.9, 1.2]
                    .map(|dx| line(12, [40.0 + dx, 12.0, 0.6], [0.0, 0.2]))
                    .concat(),
            ],
            &[],
        );
        assert_eq!(values(&statistics, "low strips"), [1.0, 2.0]);
        assert_eq!(values(&statistics, "background clusters"), [6.0]);
    }

    /// A car at 60 m with ten points on it; low grass, a bush and a crown around it, and a bush further away.
    #[test]
    fn far_cars_tell_what_stands_around_them() {
        let car = Box3 {
            center: [60.0, 0.0, 0.8],
            length: 4.4,
            width: 1.9,
            height: 1.6,
            yaw: 0.3,
            class: "Car".into(),
            score: 1.0,
            velocity: None,
            track: None,
            covariance: None,
        };
        let statistics = over_flat_ground(
            [
                line(10, [59.0, 0.0, 0.9], [0.1, 0.0]),
                line(7, [58.0, 4.0, 1.2], [0.0, 0.1]),
                line(5, [61.0, 0.0, 2.8], [0.0, 0.1]),
                line(9, [70.0, 3.0, 1.2], [0.0, 0.1]),
            ],
            &[car],
        );
        assert_eq!(values(&statistics, "own points of cars at 50-70 m"), [10.0; 3]);
        assert_eq!(values(&statistics, "within 8 m of them"), [12.0; 3]);
        assert!(values(&statistics, "own points of cars at 70-100 m").is_empty());
    }
}
